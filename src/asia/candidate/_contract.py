"""Contract of a candidate: the context of a fit and the interface of a fitted model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from asia.data import Array, Signal, Trajectory
from asia.problem import Physics
from asia.problem.symmetry import Symmetry

VALIDATION_SCORES = 200


def _no_log(step: float, loss: float) -> None:
    del step, loss


@dataclass(frozen=True)
class Context:
    """Everything that a candidate knows apart from its training trajectories."""

    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    sampling_time: float
    """Seconds."""
    n_past_u: int
    """Samples of the inputs in the past window."""
    n_past_y: int
    """Samples of the outputs in the past window."""
    horizon: int | None = None
    """Samples to simulate; None for the whole trajectory."""
    metric: str = "rmse"
    """Name of the metric that V is computed with."""
    physics: Physics | None = None
    """Equations from the problem file."""
    seed: int = 0
    """Seed for one search, fold and repeat, the same for every candidate."""
    deadline: float = float("inf")
    """Value of `time.monotonic()` after which the worker is killed."""
    threads: int = 1
    """Threads that a fit may use."""
    log: Callable[[float, float], None] = field(default=_no_log, compare=False)
    """log(step, loss): two numbers for the training curve."""
    validation_score: Callable[[Model], float] | None = field(default=None, compare=False)
    """validation_score(model): the fold's normalised metric of `model` on the held-out part, inf
    for a simulation that is not finite. There are VALIDATION_SCORES calls a fit, then it raises
    RuntimeError; its time counts as fit time. None unless the protocol's early_stopping is
    "validation", and None then too where nothing is held out: in the refit on all data."""
    symmetry: Symmetry = field(default_factory=dict[str, Mapping[str, str]])
    """Changes of the signals that leave the system's laws as they are, by name: for each signal
    that changes, the one that takes its place, with a minus where its sign changes."""

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)


class Model(Protocol):
    """A fitted model.

    It may also have `parameters() -> Mapping[str, float]`, by which the folds are compared: names
    of up to 48 characters and at most 64 finite numbers. It is asked for once, after the fit. And
    it may be a `StepModel` as well, which `asia export` prints for other programs.
    """

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in open loop, in physical units.

        `u[:, k]` and `y_hat[:, k]` are the same sample; `past_*[:, -1]` is the one before. B and H
        are 1 or more, whatever the context's horizon. The result for a row depends on that row
        only,
        y_hat[:, k] on no later input, and neither on earlier calls.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Simulated outputs y_hat (B, H, ny).
        """
        ...


Fit = Callable[[Sequence[Trajectory], Context], Model]
