"""The tables of problem.toml and of a run's lock file. Strict: nothing unknown, no guessing."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from asia.data._trajectory import Signal
from asia.data.sources import DataTable as PlainData
from asia.data.sources import SealedEntry
from asia.problem._problem import Budget
from asia.problem.physics.types import Bounds, ParameterRange, Physics
from asia.protocol._metrics import known_metric, known_test_metric
from asia.protocol._rules import (
    EarlyStopping,
    Feedback,
    FoldRule,
    OutputGroup,
    ProtocolRule,
    TestRule,
)

LEAST_MEMORY_MB = 1600
LADDER_STEP = 0.1

MetricName = Annotated[str, AfterValidator(known_metric)]
TestMetricName = Annotated[str, AfterValidator(known_test_metric)]


class Table(BaseModel):
    """One table of the file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _named(value: object) -> object:
    return {"name": value} if isinstance(value, str) else value


class SignalTable(Table):
    name: str = Field(min_length=1)
    unit: str = ""

    def signal(self) -> Signal:
        return Signal(self.name, self.unit)


SignalEntry = Annotated[SignalTable, BeforeValidator(_named)]


def _path(value: object) -> object:
    if isinstance(value, str) and (not value or "\0" in value):
        raise ValueError(f"{value!r} is not a file name")
    return value


FileName = Annotated[str, BeforeValidator(_path)]


class SealedTable(Table):
    """Test records in an encrypted store."""

    file: FileName
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class DataTable(Table):
    train: list[FileName] = []
    test: list[FileName] = []
    sealed: SealedTable | None = None
    source: str | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    groups: dict[str, list[str]] = {}
    guard: list[FileName] | Annotated[int, Field(ge=1, le=100)] = []

    def plain(self) -> PlainData:
        return PlainData(
            tuple(self.train),
            tuple(self.test),
            SealedEntry(self.sealed.file, self.sealed.sha256) if self.sealed else None,
            self.source,
            self.seed,
            self.groups,
            self.guard if isinstance(self.guard, int) else tuple(self.guard),
        )


class FoldsTable(Table):
    kind: Literal["contiguous", "leave_one_group_out"] = "contiguous"
    count: Annotated[int, Field(ge=2, le=100)] | None = None

    def rule(self) -> FoldRule:
        """Without the groups, which are known once the records were read."""
        if self.kind == "leave_one_group_out":
            return FoldRule(self.kind, 0)
        return FoldRule(self.kind, FoldRule.count if self.count is None else self.count)


class RotationTable(Table):
    """Outputs that are angles of one rotation."""

    roll_pitch_yaw: list[str] = Field(min_length=3, max_length=3)


class TestTable(Table):
    metrics: list[TestMetricName] = Field(default=["rmse"], min_length=1)
    skip: int = Field(default=0, ge=0)
    groups: dict[str, Annotated[list[str], Field(min_length=1)] | RotationTable] = {}
    horizons: list[Annotated[int, Field(ge=1)]] = []

    def rule(self) -> TestRule:
        groups = tuple(
            OutputGroup(name, tuple(entry))
            if isinstance(entry, list)
            else OutputGroup(name, tuple(entry.roll_pitch_yaw), "geodesic")
            for name, entry in self.groups.items()
        )
        return TestRule(tuple(self.metrics), self.skip, groups, tuple(self.horizons))


class ProtocolTable(Table):
    kind: Literal["simulation", "windows"] = "simulation"
    folds: FoldsTable = FoldsTable()
    past_inputs: int = Field(default=ProtocolRule.past_inputs, ge=0, le=100_000)
    past_outputs: int = Field(default=ProtocolRule.past_outputs, ge=0, le=100_000)
    metric: MetricName = "rmse"
    early_stopping: EarlyStopping = "inner"
    feedback: Feedback = "exact"
    ladder_step: Annotated[float, Field(gt=0, lt=1)] | None = None
    horizon: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    test: TestTable = TestTable()

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
            ladder=(self.ladder_step or LADDER_STEP) if self.feedback == "ladder" else None,
        )


class BudgetTable(Table):
    experiments: int = Field(default=Budget.experiments, ge=1)
    fit_seconds: float = Field(default=Budget.fit_seconds, gt=0)
    memory_mb: int = Field(default=Budget.memory_mb, ge=LEAST_MEMORY_MB)
    patience: int = Field(default=Budget.patience, ge=1)
    hours: Annotated[float, Field(gt=0)] | None = None

    def budget(self) -> Budget:
        return Budget(self.experiments, self.fit_seconds, self.memory_mb, self.patience, self.hours)


class RangeTable(Table):
    min: float
    max: float


class BoundsTable(Table):
    min: float | None = None
    max: float | None = None


class PhysicsTable(Table):
    states: list[str] = Field(min_length=1)
    dynamics: dict[str, str]
    parameters: dict[str, RangeTable] = {}
    constants: dict[str, float] = {}
    definitions: dict[str, str] = {}
    observation: dict[str, str] = {}
    bounds: dict[str, BoundsTable] = {}

    def physics(self) -> Physics:
        return Physics(
            states=tuple(self.states),
            dynamics=self.dynamics,
            parameters={k: ParameterRange(r.min, r.max) for k, r in self.parameters.items()},
            constants=self.constants,
            definitions=self.definitions,
            observation=self.observation,
            bounds={k: Bounds(b.min, b.max) for k, b in self.bounds.items()},
        )


class ProblemTables(Table):
    """What problem.toml and the lock have in common."""

    sampling_time: float = Field(gt=0)
    inputs: list[SignalEntry] = Field(min_length=1)
    outputs: list[SignalEntry] = Field(min_length=1)
    data: DataTable
    protocol: ProtocolTable = ProtocolTable()
    budget: BudgetTable = BudgetTable()
    physics: PhysicsTable | None = None


class ProblemFile(ProblemTables):
    """problem.toml; `description`, `notes` and `strategies` are paths relative to it."""

    name: Annotated[str, Field(min_length=1)] | None = None
    description: FileName | None = None
    notes: FileName | None = None
    strategies: FileName | None = None


class DigestTable(Table):
    """sha256 of what a search depends on; train records in the order of the file."""

    train: list[str]
    test: str | None = None
    guard: str | None = None
    description: str
    notes: str | None = None
    strategies: str | None = None
    baseline: str | None = None
    physics: str | None = None
    protocol: str


class LockFile(ProblemTables):
    """A run's problem.lock.toml; `description`, `notes`, `strategies` and `baseline` are the texts
    themselves."""

    name: str
    description: str
    notes: str = ""
    strategies: str = ""
    baseline: str | None = None
    digests: DigestTable
