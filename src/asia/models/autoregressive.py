"""Free-running autoregressive network: a recurrent network that predicts increments of the output.

y[k] = y[k-1] + s (W h[k] + b), h[k] from the layers driven by the input and by the model's own
y[k-1], s the standard deviation of the measured increments. It starts from the last measured
output; the layers' states before the first sample come from the past window. `feed` puts measured
outputs in place of its own while it trains. Sources: Williams and Zipser, Neural Computation 1(2),
1989 (teacher forcing); Bengio et al., Scheduled sampling, NeurIPS 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Signal, Trajectory
from asia.models import recurrent
from asia.models._arrays import AnyArray, namespace
from asia.models._networks.network import Driven, NetworkModel, Prepare, network_family
from asia.models._networks.structure import Features, Params, check_features, drive_size, zeros
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData, window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


@dataclass(frozen=True)
class Config:
    """Kind and size of the recurrent layers."""

    cell: Literal["rnn", "gru", "lstm"] = "lstm"
    """Kind of the layers."""
    hidden: int = 32
    """Units of a layer."""
    layers: int = 1
    """Layers, each of which reads the one before."""
    encoder: int = 32
    """Units of the network that maps the past window to the initial state."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        # The inner network checks the other settings.
        _ = self.inner
        check_features(self)

    @property
    def inner(self) -> recurrent.Config:
        """The recurrent network inside."""
        return recurrent.Config(
            cell=self.cell, hidden=self.hidden, layers=self.layers, encoder=self.encoder
        )


FeedbackState = tuple[Any, AnyArray]


@dataclass(frozen=True)
class AutoregressiveCell(Driven[Config]):
    """Structure of the network: see `Cell` and `OutputFeedback` in
    `asia.models._networks.structure`."""

    ny: int
    """Number of outputs."""
    measured: bool
    """The past window shows the last measured outputs."""

    @classmethod
    def of(cls, config: Config, context: Context) -> AutoregressiveCell:
        """The structure for a problem."""
        drive = Features(config.features)
        return cls(config, context.ny, context.n_past_y > 0, drive=drive)

    @property
    def inner(self) -> recurrent.RecurrentCell:
        """The recurrent network inside."""
        return _inner_cell(self.config)

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`: the output is held."""
        c = self.config
        # The inputs of the inner network include y[k-1], and its past window is one sample.
        inputs = drive_size(c.features, context.nu) + context.ny
        inner = replace(
            context,
            inputs=tuple(Signal(f"v{i}") for i in range(inputs)),
            outputs=tuple(Signal(f"w{i}") for i in range(window_size(context))),
            n_past_u=0,
            n_past_y=1,
        )
        net = dict(self.inner.parameters(inner))
        del net["out_w"], net["out_b"]
        return {
            "net": net,
            "out_w": zeros(c.hidden, context.ny),
            "out_b": zeros(context.ny),
            "fixed": {"increment": np.ones(context.ny, np.float32)},
        }

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare | None:
        """Take the size of the increments from the records."""
        del trajectories, context
        return _with_increments

    def initial(self, params: Any, window: AnyArray) -> FeedbackState:
        """Layers' states and the last measured output, its mean where none is given."""
        rest = np.zeros((window.shape[0], self.ny), window.dtype)
        y = window[:, window.shape[1] - self.ny :] if self.measured else rest
        return self.inner.initial(params["net"], window), y

    def step(
        self, params: Any, state: FeedbackState, u: AnyArray
    ) -> tuple[FeedbackState, AnyArray]:
        """Advance by one sample; the features are the output."""
        inner, y = state
        drive = namespace(u, y).concatenate([self.drive(u), y], axis=-1)
        inner, h = self.inner.step(params["net"], inner, drive)
        y = y + params["fixed"]["increment"] * (h @ params["out_w"] + params["out_b"])
        return (inner, y), y

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Return the features."""
        del params, u
        return features

    def feed(self, params: Any, state: FeedbackState, y: AnyArray, mask: AnyArray) -> FeedbackState:
        """Replace the output in the state where the mask is 1."""
        del params
        inner, own = state
        return inner, mask * y + (1 - mask) * own


# Called at every sample of a simulation.
@cache
def _inner_cell(config: Config) -> recurrent.RecurrentCell:
    return recurrent.RecurrentCell(config.inner)


def increment_sizes(records: ScaledData) -> Array:
    """Root mean square (ny,) of the outputs' increments, 1 for constant outputs."""
    steps = np.concatenate([np.diff(r.y, axis=0) for r in records])
    size = np.sqrt((steps**2).mean(axis=0))
    return np.where(size > 0, size, 1.0)


def _with_increments(params: Params, records: ScaledData, scaling: Scaling) -> Params:
    del scaling
    return {**params, "fixed": {"increment": increment_sizes(records).astype(np.float32)}}


build, train = network_family(Config, AutoregressiveCell)
