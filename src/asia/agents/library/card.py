"""Card of a kind of family for agents."""

from __future__ import annotations

from dataclasses import dataclass, replace

from asia.agents.library.family import Family
from asia.agents.library.move import Move


@dataclass(frozen=True)
class Card:
    """Families of one kind and the moves that refine them."""

    families: tuple[Family, ...]
    moves: tuple[Move, ...] = ()
    """Moves on these families alone; on all of them where a move names none."""

    def own_moves(self) -> tuple[Move, ...]:
        """The moves, each with the families it is made on."""
        names = tuple(family.name for family in self.families)
        return tuple(replace(move, families=move.families or names) for move in self.moves)
