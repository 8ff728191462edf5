"""The tables of problem.toml and of a run's lock file. Strict: nothing unknown, no guessing.

Signals, `[data]`, `[budget]` and `[physics]` are read into the dataclasses used everywhere.
`[protocol]` has tables of its own in `protocol_table`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, with_config

from asia.data.preprocess import Preprocess, without_numbers
from asia.data.sources.source import DataTable, FileName
from asia.data.trajectory import Signal
from asia.problem.budget import Budget
from asia.problem.control import ControlTable
from asia.problem.feedback import Loop
from asia.problem.physics import Physics
from asia.problem.plant import PlantTable
from asia.problem.protocol_table import ProtocolTable

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _named(signal: Signal) -> Signal:
    if not signal.name:
        raise ValueError("is a signal without a name: give it one")
    return signal


# A signal without a unit may be its name alone.
_Signal = Annotated[
    Signal,
    BeforeValidator(lambda value: {"name": value} if isinstance(value, str) else value),
    AfterValidator(_named),
]
_Signals = Annotated[tuple[_Signal, ...], Field(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class ProblemTables:
    """Tables shared by problem.toml and the lock."""

    sampling_time: Annotated[float, Field(gt=0)]
    inputs: _Signals
    outputs: _Signals
    data: DataTable
    protocol: ProtocolTable = field(default_factory=ProtocolTable)
    budget: Budget = field(default_factory=Budget)
    physics: Physics | None = None
    plant: PlantTable | None = None
    control: ControlTable | None = None
    preprocess: Annotated[Preprocess, BeforeValidator(without_numbers)] = field(
        default_factory=Preprocess
    )
    symmetry: Mapping[str, Mapping[str, str]] = field(
        default_factory=dict[str, "Mapping[str, str]"]
    )
    loop: Loop | None = None


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class ProblemFile(ProblemTables):
    """problem.toml; `description`, `notes` and `strategies` are paths relative to it."""

    name: Annotated[str, Field(min_length=1)] | None = None
    description: FileName | None = None
    notes: FileName | None = None
    strategies: FileName | None = None


@dataclass(frozen=True, kw_only=True)
class DigestTable:
    """sha256 digests of the inputs of a search; training records in the order of the file."""

    train: tuple[str, ...]
    test: str | None = None
    guard: str | None = None
    description: str
    notes: str | None = None
    strategies: str | None = None
    baseline: str | None = None
    physics: str | None = None
    plant: str | None = None
    control: str | None = None
    models: tuple[str, ...] = ()
    symmetry: str | None = None
    frequency: tuple[str, ...] | None = None
    protocol: str


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class LockFile(ProblemTables):
    """A run's problem.lock.toml; `description`, `notes`, `strategies` and `baseline` are the texts
    themselves."""

    name: str
    description: str
    notes: str = ""
    strategies: str = ""
    baseline: str | None = None
    digests: DigestTable
