"""All attacks, in the order of their numbers."""

from __future__ import annotations

from asia.redteam._types import Attack
from asia.redteam.attacks.probing import PROBING
from asia.redteam.attacks.relations import RELATIONS
from asia.redteam.attacks.scores import SCORES
from asia.redteam.attacks.searches import SEARCHES
from asia.redteam.attacks.walls import WALLS

ATTACKS: tuple[Attack, ...] = tuple(
    sorted((*SCORES, *WALLS, *SEARCHES, *PROBING, *RELATIONS), key=lambda attack: attack.number)
)
