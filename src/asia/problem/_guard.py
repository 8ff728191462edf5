"""Which records stand guard: kept from every fold and agent, and looked at when a search ends."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asia._nearest import suggestion
from asia.data._trajectory import Trajectory
from asia.data.sources.kinds import CsvSource, DataSource, GuardSource, SimulatedSource
from asia.errors import UserError


def guard_source(named: Sequence[str] | int, data: DataSource, root: Path) -> GuardSource:
    """What data.guard names. Raises UserError when it does not go with the data source."""
    if isinstance(data, SimulatedSource):
        if not isinstance(named, int):
            if named:
                raise UserError(
                    "data.guard names records, but a simulated source makes them: say how many, "
                    "such as guard = 2"
                )
            return GuardSource()
        return GuardSource(count=named)
    if isinstance(named, int):
        raise UserError(
            f"data.guard is {named}, which only a simulated source understands: name the "
            f"{'files' if isinstance(data, CsvSource) else 'training records'}"
        )
    if isinstance(data, CsvSource):
        return GuardSource(paths=tuple((root / name).resolve() for name in named))
    return GuardSource(names=tuple(named))


def without_guard(records: Sequence[Trajectory], guard: GuardSource) -> tuple[Trajectory, ...]:
    """The records of a benchmark that are left to train on. Raises UserError for a name that is not
    among them, and when none is left."""
    known = [record.name for record in records]
    for name in guard.names:
        if name not in known:
            raise UserError(
                f"data.guard: no training record is called '{name}'{suggestion(name, known)}"
            )
    left = tuple(record for record in records if record.name not in guard.names)
    if not left:
        raise UserError("data.guard takes every training record: leave some to train on")
    return left


def guard_table(guard: GuardSource) -> list[str] | int | None:
    """data.guard, from which the same source is read; None without one."""
    if guard.count:
        return guard.count
    return [*map(str, guard.paths), *guard.names] or None
