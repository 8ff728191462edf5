"""All attacks, in the order of their numbers. A number is never given twice."""

from tests.redteam.attacks.answers import RELATIONS
from tests.redteam.attacks.copies import COPIES
from tests.redteam.attacks.limits import LIMITS
from tests.redteam.attacks.probing import PROBING, STATISTICS
from tests.redteam.attacks.scores import SCORES
from tests.redteam.attacks.searches import SEARCHES
from tests.redteam.attacks.walls import WALLS
from tests.redteam.types import Attack

ATTACKS: tuple[Attack, ...] = tuple(
    sorted(
        (*SCORES, *WALLS, *SEARCHES, *PROBING, *RELATIONS, *LIMITS, *STATISTICS, *COPIES),
        key=lambda attack: attack.number,
    )
)
