"""Rules of a protocol: folds, past windows, horizon, metric, test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

EarlyStopping = Literal["inner", "validation"]
FoldKind = Literal["contiguous", "forward", "tail", "leave_one_group_out"]
ShownResidual = Literal["train", "held_out"]


@dataclass(frozen=True)
class Group:
    """Training records held out together, by name."""

    name: str
    records: tuple[str, ...]


@dataclass(frozen=True)
class FoldRule:
    """Rule for the samples that each fold holds out."""

    kind: FoldKind = "contiguous"
    """`contiguous`: each record is cut into blocks, and a fold holds out one block of each record;
    `forward`: the same with one block more, and only what lies before the held-out block trains,
    so that the first block is never held out; `tail`: the same within the last `tail` samples of
    each record, the samples before them always train; `leave_one_group_out`: a fold holds out
    the records of one group."""
    count: int = 2
    groups: tuple[Group, ...] = ()
    """The groups; () for folds of another kind."""
    gap: int | None = None
    """Samples next to a held-out block that do not train; None for none."""
    tail: int | None = None
    """Samples at the end of each record that `tail` folds hold out; None for folds of another
    kind."""
    period: int | None = None
    """Samples after which the inputs repeat, mirrored or scaled too: each period is cut into
    `count` blocks, and a contiguous fold holds out one block of every period; None where whole
    records are cut."""


@dataclass(frozen=True)
class OutputGroup:
    """Outputs whose error is one distance at each step: `euclidean`, or `geodesic` between the
    rotations given by roll, pitch and yaw (Z-Y-X, rad)."""

    name: str
    outputs: tuple[str, ...]
    distance: Literal["euclidean", "geodesic"] = "euclidean"


@dataclass(frozen=True)
class TestRule:
    """Rule for the metrics of the sealed test."""

    metrics: tuple[str, ...] = ("rmse",)
    skip: int = 0
    """Samples after the past window that are left out."""
    groups: tuple[OutputGroup, ...] = ()
    horizons: tuple[int, ...] = ()
    """Steps of a window that this table prints, 1 being the first."""
    unit: str | None = None
    """The unit of the official figures, such as `mV`; None where they are in the output's."""
    unit_factor: float | None = None
    """Factor from the output's unit to `unit`; None for 1."""
    figures: tuple[Group, ...] = ()
    """The official figures, each the mean over test records that match its names or wildcards; ()
    where each test record is a figure of its own."""


@dataclass(frozen=True)
class ProtocolRule:
    """Rule for V and the test metric, frozen and hashed before the first experiment."""

    kind: Literal["simulation", "windows", "control"] = "simulation"
    """`simulation` of whole blocks, `windows` of `horizon` samples, each started from its own past
    window, or `control` in the scenarios of [control]."""
    folds: FoldRule = FoldRule()
    past_inputs: int = 10
    """Input samples that a model sees before it simulates."""
    past_outputs: int = 10
    """Output samples that a model sees before it simulates."""
    metric: str = "rmse"
    early_stopping: EarlyStopping = "inner"
    """`inner`, or `validation` as in Piga and Forgione, where a candidate may ask for its score on
    the held-out samples while it trains; V is then not leak-free."""
    horizon: int | None = None
    test: TestRule = TestRule()
    residuals: ShownResidual = "train"
    """Samples whose residuals agents see: of the training records, or of the held-out ones too, to
    which a model can then be fitted by hand."""
    tolerance: tuple[float, ...] | None = None
    """Size of an error of each output that V counts as 1; None for its standard deviation."""

    @property
    def past(self) -> int:
        """Samples before the first simulated one."""
        return max(self.past_inputs, self.past_outputs)
