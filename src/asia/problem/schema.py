"""The tables of problem.toml and of a run's lock file. Strict: nothing unknown, no guessing.

Signals, `[data]`, `[budget]` and `[physics]` are read into the dataclasses used everywhere.
`[protocol]` has tables of its own: the digest of a protocol covers every field of its rule, so that
the rule has no room for words of the file alone (`feedback`, a fold count that may be left out).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, with_config

from asia.data.preprocess import Preprocess
from asia.data.sources.source import DataTable, FileName
from asia.data.trajectory import Signal
from asia.problem.budget import Budget
from asia.problem.metrics import known_metric, known_test_metric
from asia.problem.physics import Physics
from asia.problem.protocol import (
    EarlyStopping,
    Feedback,
    FoldKind,
    FoldRule,
    Group,
    OutputGroup,
    ProtocolRule,
    ShownResidual,
    TestRule,
)

LADDER_STEP = 0.1
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _as_table(value: object) -> object:
    return {"name": value} if isinstance(value, str) else value


def _with_a_name(signal: Signal) -> Signal:
    if not signal.name:
        raise ValueError("is a signal without a name: give it one")
    return signal


_Signals = Annotated[
    tuple[Annotated[Signal, BeforeValidator(_as_table), AfterValidator(_with_a_name)], ...],
    Field(min_length=1),
]
_Outputs = Annotated[tuple[str, ...], Field(min_length=1)]
_Records = _Outputs
_MetricName = Annotated[str, AfterValidator(known_metric)]
_TestMetricName = Annotated[str, AfterValidator(known_test_metric)]
_PastSamples = Annotated[int, Field(ge=0, le=100_000)]


@dataclass(frozen=True)
class FoldsTable:
    kind: FoldKind = "contiguous"
    count: Annotated[int, Field(ge=1, le=100)] | None = None
    gap: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    tail: Annotated[int, Field(ge=1, le=100_000_000)] | None = None

    def rule(self) -> FoldRule:
        """Return the fold rule without its groups, which are known once the records were read."""
        if self.kind == "leave_one_group_out":
            return FoldRule(self.kind, 0)
        count = FoldRule.count if self.count is None else self.count
        return FoldRule(self.kind, count, gap=self.gap or None, tail=self.tail)


@dataclass(frozen=True)
class RotationTable:
    """Outputs that are angles of one rotation."""

    roll_pitch_yaw: Annotated[tuple[str, ...], Field(min_length=3, max_length=3)]
    """Names of the three outputs."""


@dataclass(frozen=True)
class TestTable:
    metrics: Annotated[tuple[_TestMetricName, ...], Field(min_length=1)] = ("rmse",)
    skip: Annotated[int, Field(ge=0)] = 0
    groups: Mapping[str, _Outputs | RotationTable] = field(
        default_factory=dict[str, "_Outputs | RotationTable"]
    )
    horizons: tuple[Annotated[int, Field(ge=1)], ...] = ()
    unit: Annotated[str, Field(min_length=1)] | None = None
    unit_factor: Annotated[float, Field(gt=0)] | None = None
    figures: Mapping[str, _Records] = field(default_factory=dict[str, _Records])

    def rule(self) -> TestRule:
        groups = tuple(
            OutputGroup(name, entry.roll_pitch_yaw, "geodesic")
            if isinstance(entry, RotationTable)
            else OutputGroup(name, entry)
            for name, entry in self.groups.items()
        )
        figures = tuple(Group(name, records) for name, records in self.figures.items())
        return TestRule(
            self.metrics, self.skip, groups, self.horizons, self.unit, self.unit_factor, figures
        )


@dataclass(frozen=True)
class ProtocolTable:
    kind: Literal["simulation", "windows"] = "simulation"
    folds: FoldsTable = FoldsTable()
    past_inputs: _PastSamples = ProtocolRule.past_inputs
    past_outputs: _PastSamples = ProtocolRule.past_outputs
    metric: _MetricName = "rmse"
    early_stopping: EarlyStopping = "inner"
    feedback: Feedback = "exact"
    ladder_step: Annotated[float, Field(gt=0, lt=1)] | None = None
    horizon: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    test: TestTable = TestTable()
    residuals: ShownResidual = "train"

    def rule(self) -> ProtocolRule:
        return ProtocolRule(
            kind=self.kind,
            folds=self.folds.rule(),
            past_inputs=self.past_inputs,
            past_outputs=self.past_outputs,
            metric=self.metric,
            early_stopping=self.early_stopping,
            horizon=self.horizon,
            test=self.test.rule(),
            residuals=self.residuals,
            ladder=(self.ladder_step or LADDER_STEP) if self.feedback == "ladder" else None,
        )


@dataclass(frozen=True, kw_only=True)
class ProblemTables:
    """Tables shared by problem.toml and the lock."""

    sampling_time: Annotated[float, Field(gt=0)]
    inputs: _Signals
    outputs: _Signals
    data: DataTable
    protocol: ProtocolTable = ProtocolTable()
    budget: Budget = field(default_factory=Budget)
    physics: Physics | None = None
    preprocess: Preprocess = field(default_factory=Preprocess)
    symmetry: Mapping[str, Mapping[str, str]] = field(
        default_factory=dict[str, "Mapping[str, str]"]
    )


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
    symmetry: str | None = None
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
