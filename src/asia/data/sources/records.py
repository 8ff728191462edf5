"""From a data source to records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from asia._nearest import nearest
from asia.data._store import open_store
from asia.data._trajectory import Array, Signal, Trajectory
from asia.data.sources.benchmarks import benchmark_records, check_benchmark
from asia.data.sources.csv import read_csv
from asia.data.sources.kinds import (
    BenchmarkSource,
    CsvSource,
    DataSource,
    GuardSource,
    NanodroneSource,
    SealedSource,
    SimulatedSource,
)
from asia.data.sources.nanodrone import flight_paths
from asia.data.sources.two_tanks import SAMPLING_TIME, simulate_two_tanks
from asia.errors import UserError

_SYSTEMS = ("two_tanks",)
_REALISATIONS = {"train": 0, "test": 1}
_GUARD = 2


@dataclass(frozen=True)
class Channels:
    """Which channels to read, and their sampling time in seconds."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sampling_time: float


@dataclass(frozen=True)
class Records:
    """What a source held; truth: noise-free outputs, for simulated systems only."""

    trajectories: tuple[Trajectory, ...]
    truth: tuple[Array, ...] | None = None
    warnings: tuple[str, ...] = ()


def parse_source(text: str, seed: int | None) -> DataSource:
    """`nonlinear_benchmarks:<name>`, `nanodrone` or `simulated:<system>`. Raises UserError."""
    kind, _, name = text.partition(":")
    if kind == "simulated":
        if name not in _SYSTEMS:
            raise UserError(f"data.source: no simulated system '{name}'{nearest(name, _SYSTEMS)}")
        return SimulatedSource(name, seed or 0)
    if seed is not None:
        raise UserError("data.seed belongs to a simulated source: leave it out")
    if text == "nanodrone":
        return NanodroneSource()
    if kind != "nonlinear_benchmarks":
        raise UserError(
            f"data.source is '{text}', expected 'nonlinear_benchmarks:<name>', 'nanodrone' or "
            "'simulated:<system>'; CSV files are named in data.train and data.test"
        )
    check_benchmark(name)
    return BenchmarkSource(name)


def read_records(source: DataSource, part: Literal["train", "test"], channels: Channels) -> Records:
    """The records of one part. `part` is without effect on CSV files, which are named apart.

    Raises UserError when the data cannot be read or do not fit the channels.
    """
    if isinstance(source, CsvSource):
        return _csv_records(source.paths, channels)
    if isinstance(source, NanodroneSource):
        return _csv_records(flight_paths(part), channels)
    if isinstance(source, SimulatedSource):
        record = simulate_two_tanks(source.seed, _REALISATIONS[part])
        name = f"{source.system}_{part}"
        trajectory = Trajectory(record.u, record.y, SAMPLING_TIME, name)
        _check_channels((trajectory,), channels)
        return Records((trajectory,), (record.truth,))
    trajectories = benchmark_records(source.benchmark, part)
    _check_channels(trajectories, channels)
    return Records(trajectories)


def guard_records(guard: GuardSource, data: DataSource, channels: Channels) -> Records:
    """The records that stand guard. Raises UserError as `read_records`."""
    if isinstance(data, CsvSource):
        return _csv_records(guard.paths, channels)
    if not isinstance(data, SimulatedSource):
        found = read_records(data, "train", channels).trajectories
        return Records(tuple(record for record in found if record.name in guard.names))
    made = tuple(
        Trajectory(record.u, record.y, SAMPLING_TIME, f"{data.system}_guard{number}")
        for number, record in enumerate(
            (simulate_two_tanks(data.seed, _GUARD + k) for k in range(guard.count)), 1
        )
    )
    _check_channels(made, channels)
    return Records(made)


def sealed_records(source: SealedSource, channels: Channels, keys: Path) -> Records:
    """The records of an encrypted store. Raises UserError without its key, or when it was
    changed."""
    inputs, outputs = [s.name for s in channels.inputs], [s.name for s in channels.outputs]
    found = [
        read_csv(Path(c.name), inputs, outputs, channels.sampling_time, c.data)
        for c in open_store(source.path, keys)
    ]
    return Records(tuple(record.trajectory for record in found))


def _csv_records(paths: Sequence[Path], channels: Channels) -> Records:
    inputs, outputs = [s.name for s in channels.inputs], [s.name for s in channels.outputs]
    found = [read_csv(path, inputs, outputs, channels.sampling_time) for path in paths]
    stems = Counter(path.stem for path in paths)
    trajectories = tuple(
        record.trajectory
        if stems[path.stem] == 1
        else replace(record.trajectory, name=f"{path.parent.name}/{path.stem}")
        for path, record in zip(paths, found, strict=True)
    )
    return Records(trajectories, None, tuple(w for record in found for w in record.warnings))


def _check_channels(trajectories: Sequence[Trajectory], channels: Channels) -> None:
    for t in trajectories:
        for what, have, named in (
            ("inputs", t.u.shape[1], len(channels.inputs)),
            ("outputs", t.y.shape[1], len(channels.outputs)),
        ):
            if have != named:
                raise UserError(f"record '{t.name}' has {have} {what}, but {named} are named")
        if abs(t.sampling_time - channels.sampling_time) > 1e-3 * t.sampling_time:
            raise UserError(
                f"sampling_time is {channels.sampling_time:g} s, but record '{t.name}' was "
                f"sampled every {t.sampling_time:g} s"
            )
