"""The rules of judgement: folds, past windows, horizon, metric."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

EarlyStopping = Literal["inner", "validation"]
Feedback = Literal["exact", "ladder"]


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

    metrics: tuple[str, ...] = ("rmse",)
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
    metric: str = "rmse"
    early_stopping: EarlyStopping = "inner"
    horizon: int | None = None
    test: TestRule = TestRule()
    ladder: float | None = None

    @property
    def past(self) -> int:
        """Samples before the first simulated one."""
        return max(self.past_inputs, self.past_outputs)
