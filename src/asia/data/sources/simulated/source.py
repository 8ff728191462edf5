"""Simulated records: the source and its record type."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from asia._text import nearest
from asia.data.sources.simulated import Simulation, bouc_wen, open_loop, two_tanks
from asia.data.sources.source import Channels, DataTable, Source, SourceData, Subset
from asia.data.trajectory import Trajectory
from asia.errors import UserError


@dataclass(frozen=True)
class SimulatedSystem:
    """A system by its equations."""

    sampling_time: float
    records: Callable[[int, Subset, int], Mapping[str, Simulation]]
    """Function of a seed, a subset and the number of guard records that returns the records of that
    subset by name."""


SYSTEMS: Mapping[str, SimulatedSystem] = {
    "two_tanks": SimulatedSystem(two_tanks.SAMPLING_TIME, two_tanks.two_tanks_records),
    "bouc_wen": SimulatedSystem(bouc_wen.SAMPLING_TIME, bouc_wen.bouc_wen_records),
    "quadruple_tank": SimulatedSystem(
        open_loop.QUADRUPLE_TANK_TIME, open_loop.quadruple_tank_records
    ),
    "cstr": SimulatedSystem(open_loop.CSTR_TIME, open_loop.cstr_records),
}
"""The systems by name."""


@dataclass(frozen=True)
class Simulated(Source):
    """System that is simulated on each read; the seed fixes every number."""

    seed: int = 0
    guard: int = 0
    system: str = "two_tanks"

    usage: ClassVar[str] = "simulated:<system>"
    test_kept: ClassVar[str] = (
        "simulated from a seed in the problem file: anyone with ASIA can repeat it"
    )

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        del root
        name = (table.source or "").partition(":")[2]
        if name not in SYSTEMS:
            raise UserError(f"data.source: no simulated system '{name}'{nearest(name, SYSTEMS)}")
        if not isinstance(table.guard, int) and table.guard:
            raise UserError(
                "data.guard names records, but a simulated source makes them: say how many, such "
                "as guard = 2"
            )
        return cls(table.seed or 0, table.guard if isinstance(table.guard, int) else 0, name)

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        del channels
        system = SYSTEMS[self.system]
        made = system.records(self.seed, subset, self.guard)
        return SourceData(
            tuple(Trajectory(m.u, m.y, system.sampling_time, name) for name, m in made.items()),
            tuple(m.truth for m in made.values()),
        )

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """Return no places: nothing is stored."""
        del subset
        return ()

    def to_toml(self) -> dict[str, Any]:
        return {
            "source": f"simulated:{self.system}",
            "seed": self.seed,
            "guard": self.guard or None,
        }

    @property
    def guard_names(self) -> tuple[str, ...]:
        return tuple(f"{self.system}_guard{k}" for k in range(1, self.guard + 1))
