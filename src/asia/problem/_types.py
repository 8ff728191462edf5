"""What a person brings: signals, records, physics and the rules of judgement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asia.errors import UserError

Array = NDArray[np.float64]
Metric = Literal["rmse", "mae"]
TestMetric = Literal["rmse", "mae", "mee"]
EarlyStopping = Literal["inner", "validation"]
Feedback = Literal["exact", "ladder"]


@dataclass(frozen=True)
class Signal:
    """Name and unit of one input or output channel."""

    name: str
    unit: str = ""

    @property
    def label(self) -> str:
        """`name [unit]`, for axes and tables."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def _frozen(values: object, what: str) -> Array:
    array = np.array(values, dtype=np.float64, order="C")
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise UserError(f"{what}: expected an array (samples, channels), got shape {array.shape}")
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0]
        raise UserError(
            f"{what}: missing or infinite value at sample {bad[0]}, channel {bad[1]}; "
            "fill or cut the record there"
        )
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Trajectory:
    """One contiguous record.

    u: (T, nu) inputs and y: (T, ny) outputs in physical units, float64, read-only; sampling_time
    in seconds. Raises UserError on unequal lengths and on values that are not finite.
    """

    u: Array
    y: Array
    sampling_time: float
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "u", _frozen(self.u, f"inputs of record '{self.name}'"))
        object.__setattr__(self, "y", _frozen(self.y, f"outputs of record '{self.name}'"))
        if len(self.u) != len(self.y):
            raise UserError(
                f"record '{self.name}': {len(self.u)} input samples but {len(self.y)} output "
                "samples; both need the same length"
            )

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, part: slice) -> Trajectory:
        return Trajectory(self.u[part], self.y[part], self.sampling_time, self.name)


@dataclass(frozen=True)
class ParameterRange:
    """Search range of a physical parameter; `min > 0` is searched on a log scale."""

    min: float
    max: float


@dataclass(frozen=True)
class Bounds:
    """Physical range of a state; None is open."""

    min: float | None = None
    max: float | None = None


@dataclass(frozen=True)
class Physics:
    """The person's equations. Expressions are text in the names of states, inputs, parameters,
    constants and definitions; `_expressions.py` says what they may hold."""

    states: tuple[str, ...]
    dynamics: Mapping[str, str]
    parameters: Mapping[str, ParameterRange] = field(default_factory=dict[str, ParameterRange])
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    definitions: Mapping[str, str] = field(default_factory=dict[str, str])
    observation: Mapping[str, str] = field(default_factory=dict[str, str])
    bounds: Mapping[str, Bounds] = field(default_factory=dict[str, Bounds])


@dataclass(frozen=True)
class Group:
    """Training records held out together, by name."""

    name: str
    records: tuple[str, ...]


@dataclass(frozen=True)
class FoldRule:
    """`contiguous`: each record cut into `count` blocks, one block of each held out a fold;
    `leave_one_group_out`: each of `groups` held out once, `count` is their number."""

    kind: Literal["contiguous", "leave_one_group_out"] = "contiguous"
    count: int = 2
    groups: tuple[Group, ...] = ()


@dataclass(frozen=True)
class OutputGroup:
    """Outputs whose error is one distance at each step: `euclidean`, or `geodesic` between the
    rotations given by roll, pitch and yaw (Z-Y-X, rad)."""

    name: str
    outputs: tuple[str, ...]
    distance: Literal["euclidean", "geodesic"] = "euclidean"


@dataclass(frozen=True)
class TestRule:
    """How the sealed test is measured: `skip` samples after the past window are left out.
    `groups` and `horizons` (samples, 1-based) are those of the Mean Euclidean Error table."""

    metrics: tuple[TestMetric, ...] = ("rmse",)
    skip: int = 0
    groups: tuple[OutputGroup, ...] = ()
    horizons: tuple[int, ...] = ()


@dataclass(frozen=True)
class ProtocolRule:
    """How V and the test metric are computed. Frozen and hashed before the first experiment.

    kind: `simulation` of whole blocks, or `windows` of `horizon` samples, each started from its own
    past window. early_stopping: `inner`, or `validation` as in Piga and Forgione, where a candidate
    may ask for its score on the held-out part while it trains; V is then not leak-free. ladder: the
    share of V by which a new best must be better for agents to be told, None where they are told
    all of V.
    """

    kind: Literal["simulation", "windows"] = "simulation"
    folds: FoldRule = FoldRule()
    past_inputs: int = 10
    past_outputs: int = 10
    metric: Metric = "rmse"
    early_stopping: EarlyStopping = "inner"
    horizon: int | None = None
    test: TestRule = TestRule()
    ladder: float | None = None

    @property
    def past(self) -> int:
        """Samples before the first simulated one."""
        return max(self.past_inputs, self.past_outputs)


@dataclass(frozen=True)
class Budget:
    """What a search may spend. `patience`: experiments in the refine phase without a better
    model before it counts as saturated; `hours`: wall clock, None is open."""

    experiments: int = 15
    fit_seconds: float = 120.0
    memory_mb: int = 4096
    patience: int = 10
    hours: float | None = None
