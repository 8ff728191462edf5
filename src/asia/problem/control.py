"""Control problem: a plant in closed loop, its scenarios, and the cost of a controller.

The closed loop is a system from signals outside of it (set points, disturbances, measurement noise,
plant parameters) to its responses (controlled outputs, changes of the inputs). A scenario is a
record of these: its inputs are the signals from outside, its outputs are the targets, set points
and no change. So the error of a response is what a controller pays for, and folds, sealed test,
guard and metric are those of every problem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

# Not from pydantic, which is too heavy for a worker.
from annotated_types import Ge, Gt, Le

from asia._text import suggestion
from asia.data.sources.source import Channels, DataTable, Source, SourceData, Subset
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.problem.control_task import Actuator, ControlTask
from asia.problem.plant import Plant
from asia.problem.problem import Problem, TestSource
from asia.problem.protocol import FoldRule, Group, ProtocolRule

_DECIMALS = 9


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Signal that is constant for a while, then steps to a value drawn from a range."""

    min: float
    max: float
    hold: Annotated[float, Gt(0)] = inf
    """Mean time between steps in s; the times are drawn from half to one and a half of it."""
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.min <= self.max:
            raise ValueError(f"is a range from {self.min:g} to {self.max:g}: min is above max")

    def drawn(self, random: np.random.Generator, samples: int, sampling_time: float) -> Array:
        """Draw a signal (T,)."""
        found, start = np.empty(samples), 0
        while start < samples:
            share = float(random.uniform(0.5, 1.5))
            length = (
                samples if self.hold == inf else max(round(share * self.hold / sampling_time), 1)
            )
            found[start : start + length] = random.uniform(self.min, self.max)
            start += length
        return np.round(found, _DECIMALS)


@dataclass(frozen=True, kw_only=True)
class ScenarioTable:
    """[control.scenarios]: numbers of scenarios, which are drawn from a seed."""

    samples: Annotated[int, Ge(20), Le(100_000)]
    train: Annotated[int, Ge(2), Le(200)] = 6
    folds: Annotated[int, Ge(2), Le(100)] = 3
    test: Annotated[int, Ge(1), Le(200)] = 4
    guard: Annotated[int, Ge(0), Le(100)] = 0
    seed: Annotated[int, Ge(0)] = 0

    def __post_init__(self) -> None:
        if self.train < self.folds:
            raise ValueError(f"has {self.train} training scenarios for {self.folds} folds")


@dataclass(frozen=True, kw_only=True)
class ControlTable:
    """[control] of problem.toml."""

    actuators: Mapping[str, Actuator]
    """Limits of every input."""
    setpoints: Mapping[str, Steps]
    """Set points of outputs; an output without one is measured only."""
    scenarios: ScenarioTable
    tolerance: Mapping[str, float]
    """Size of an error that costs 1: of a controlled output in its unit, and of an input in units
    of change from sample to sample; a tenth of its range by default."""
    disturbances: Mapping[str, Steps] = field(default_factory=dict[str, Steps])
    """Further inputs of the plant, which no controller sees."""
    noise: Mapping[str, float] = field(default_factory=dict[str, float])
    """Standard deviation of the measurement noise of outputs."""


@dataclass(frozen=True, eq=False)
class Control:
    """Plant and cost of a control problem."""

    table: ControlTable
    plant: Plant
    base: Problem
    """Identification problem of the same plant: signals, open-loop records, equations."""
    models: tuple[bytes, ...] = field(default=(), repr=False)
    """Models identified from these records; opaque outside of a sandbox."""

    @property
    def controlled(self) -> tuple[Signal, ...]:
        """Outputs with a set point."""
        return tuple(s for s in self.base.outputs if s.name in self.table.setpoints)

    @property
    def outside(self) -> tuple[Signal, ...]:
        """Signals from outside of the loop: set points, disturbances, noise, plant parameters and
        initial states."""
        table, plant = self.table, self.plant
        noisy = (s for s in self.base.outputs if s.name in table.noise)
        unknown = {**plant.parameters, **plant.initial}
        return (
            *(Signal(f"{s.name}_setpoint", s.unit) for s in self.controlled),
            *(Signal(name, steps.unit) for name, steps in table.disturbances.items()),
            *(Signal(f"{s.name}_noise", s.unit) for s in noisy),
            *(Signal(name, one.unit) for name, one in unknown.items()),
        )

    @property
    def responses(self) -> tuple[Signal, ...]:
        """Controlled outputs, then the changes of the inputs from sample to sample."""
        changes = (Signal(f"{s.name}_change", s.unit) for s in self.base.inputs)
        return (*self.controlled, *changes)

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Limits of the inputs."""
        return tuple(self.table.actuators[s.name] for s in self.base.inputs)

    @property
    def tolerance(self) -> tuple[float, ...]:
        """Tolerance of each response."""
        given = self.table.tolerance
        return (
            *(given[s.name] for s in self.controlled),
            *(
                given.get(s.name, 0.1 * (a.max - a.min))
                for s, a in zip(self.base.inputs, self.actuators, strict=True)
            ),
        )

    def task(self) -> ControlTask:
        """The part that candidates may know."""
        table = self.table
        return ControlTask(
            setpoints=tuple(s.name for s in self.controlled),
            controlled=tuple(self.base.outputs.index(s) for s in self.controlled),
            actuators=self.actuators,
            tolerance=self.tolerance,
            noise=tuple(table.noise.get(s.name, 0.0) for s in self.base.outputs),
            ranges=tuple(
                (table.setpoints[s.name].min, table.setpoints[s.name].max) for s in self.controlled
            ),
            records=self.base.train,
            models=self.models,
            metric=self.base.protocol.metric,
        )

    def toml(self) -> dict[str, Any]:
        """[control], with the defaults filled in."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {k: plain(v) for k, v in value.items() if v != inf}
            return value

        return {k: v for k, v in plain(asdict(self.table)).items() if v != {}}


@dataclass(frozen=True)
class Scenarios(Source):
    """Scenarios of a control problem; the seed fixes every number."""

    control: Control
    test_kept = "drawn from a seed in the problem file: anyone with the file can repeat them"

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        raise NotImplementedError("scenarios come from [control]")

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        table = self.control.table.scenarios
        count = {"train": table.train, "test": table.test, "guard": table.guard}[subset]
        time = channels.sampling_time
        return SourceData(tuple(self._drawn(subset, k, time) for k in range(count)))

    def _drawn(self, subset: Subset, number: int, sampling_time: float) -> Trajectory:
        control, table = self.control, self.control.table
        place = ("train", "test", "guard").index(subset)
        random = np.random.default_rng([table.scenarios.seed, place, number])
        samples = table.scenarios.samples

        def steps(one: Steps) -> Array:
            return one.drawn(random, samples, sampling_time)

        targets = [steps(table.setpoints[s.name]) for s in control.controlled]
        columns = [*targets, *(steps(one) for one in table.disturbances.values())]
        for s in control.base.outputs:
            if s.name in table.noise:
                drawn = table.noise[s.name] * random.standard_normal(samples)
                columns.append(np.round(drawn, _DECIMALS))
        for one in (*control.plant.parameters.values(), *control.plant.initial.values()):
            columns.append(np.full(samples, float(random.uniform(one.min, one.max))))
        still = [np.zeros(samples)] * len(control.base.inputs)
        return Trajectory(
            np.stack(columns, axis=1), np.stack([*targets, *still], axis=1), sampling_time,
            f"{subset}{number + 1}",
        )  # fmt: skip

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """Records and plant of a user's own, which no worker may read; none of a test or guard,
        which is drawn."""
        if subset != "train":
            return ()
        plant = Path(self.control.plant.source.rpartition(":")[0] or self.control.plant.source)
        own = () if self.control.plant.is_built_in else (plant,)
        return (*self.control.base.data.places("train"), *own)

    def to_toml(self) -> dict[str, Any]:
        return self.control.base.data.to_toml()

    @property
    def guard_names(self) -> tuple[str, ...]:
        return tuple(f"guard{k + 1}" for k in range(self.control.table.scenarios.guard))


def check_control(table: ControlTable, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raise UserError where a table names signals that are not there, or leaves some out."""
    for what, named, known in (
        ("actuators", table.actuators, inputs),
        ("setpoints", table.setpoints, outputs),
        ("noise", table.noise, outputs),
        ("tolerance", table.tolerance, [*table.setpoints, *inputs]),
    ):
        for name in named:
            if name not in known:
                raise UserError(
                    f"[control.{what}]: there is no signal '{name}'{suggestion(name, list(known))}"
                )
    for name in inputs:
        if name not in table.actuators:
            raise UserError(f"[control.actuators] leaves out input '{name}': give min, max, start")
    if not table.setpoints:
        raise UserError("[control.setpoints] is empty: name an output with min, max and hold")
    for name in table.setpoints:
        if name not in table.tolerance:
            raise UserError(
                f"[control.tolerance] leaves out '{name}': give the size of an error that costs 1"
            )
    for what, values in (("tolerance", table.tolerance), ("noise", table.noise)):
        for name, value in values.items():
            if not 0 < value < inf:
                raise UserError(f"[control.{what}] {name} is {value:g}, expected a positive number")


def control_problem(base: Problem, table: ControlTable, plant: Plant) -> Problem:
    """Make the control problem of a plant from its identification problem.

    Raises:
        UserError: for tables that do not fit together
    """
    for what, given in (
        ("[preprocess]", base.preprocess), ("[loop]", base.loop), ("[symmetry]", base.symmetry),
        ("data.guard", base.guard_names), ("[protocol] horizon", base.protocol.horizon),
        ('early_stopping = "validation"', base.protocol.early_stopping == "validation"),
    ):  # fmt: skip
        if given:
            raise UserError(f"{what} is not for problems with [control]: leave it out")
    control = Control(table, plant, base)
    names = [s.name for s in (*control.outside, *control.responses, *base.inputs)]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"[control]: two signals are called '{name}': rename one of them")
    source = Scenarios(control)
    channels = Channels(control.outside, control.responses, base.sampling_time)
    records = source.records("train", channels).trajectories
    count = table.scenarios.folds
    groups = tuple(
        Group(f"scenarios {k + 1}", tuple(r.name for r in records[k::count])) for k in range(count)
    )
    rule = ProtocolRule(
        kind="control",
        folds=FoldRule("leave_one_group_out", count, groups),
        past_inputs=0,
        past_outputs=0,
        metric=base.protocol.metric,
        test=replace(base.protocol.test, metrics=(base.protocol.metric,), skip=0),
        tolerance=control.tolerance,
    )
    return replace(
        base,
        inputs=control.outside,
        outputs=control.responses,
        train=records,
        data=source,
        test=TestSource(source),
        protocol=rule,
        physics=None,
        plant=None,
        truth=None,
        period=None,
        responses=(),
        response_files=(),
        control=control,
    )
