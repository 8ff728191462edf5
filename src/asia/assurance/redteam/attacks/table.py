"""All attacks, in the order of their numbers."""

from asia.assurance.redteam.attacks.answers import RELATIONS
from asia.assurance.redteam.attacks.limits import LIMITS
from asia.assurance.redteam.attacks.literals import LITERALS
from asia.assurance.redteam.attacks.probing import PROBING, STATISTICS
from asia.assurance.redteam.attacks.scores import SCORES
from asia.assurance.redteam.attacks.searches import SEARCHES
from asia.assurance.redteam.attacks.walls import WALLS
from asia.assurance.redteam.types import Attack

ATTACKS: tuple[Attack, ...] = tuple(
    sorted(
        (*SCORES, *WALLS, *SEARCHES, *PROBING, *RELATIONS, *LIMITS, *STATISTICS, *LITERALS),
        key=lambda attack: attack.number,
    )
)
