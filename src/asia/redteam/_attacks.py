"""All attacks, in the order of their numbers."""

from __future__ import annotations

from asia.redteam._probing import PROBING
from asia.redteam._scores import SCORES
from asia.redteam._searches import SEARCHES
from asia.redteam._types import Attack
from asia.redteam._walls import WALLS

ATTACKS: tuple[Attack, ...] = tuple(
    sorted((*SCORES, *WALLS, *SEARCHES, *PROBING), key=lambda attack: attack.number)
)
