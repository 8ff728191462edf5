"""Kinematic recurrent network: it predicts increments of the velocities, and these are integrated.

    y_i[k] = y_i[k-1] + s_i (W h[k] + b)_i          an output that moves by itself
    y_j[k] = y_j[k-1] + gain_j Ts y_i[k-1]          an output whose rate is y_i

The layers that give h[k] are those of `asia.models.autoregressive`, driven by the inputs and the
model's own y[k-1]; the gains are learned too. Which output is the rate of which comes from
[physics] or from the training records, see `asia.models._equations.measured`.
Sources: Piga and Forgione (KinematicsLSTM, motor speeds squared, scheduled sampling).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.models import autoregressive
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.measured import find_rates, read_by_equations
from asia.models._networks.network import NetworkModel, Prepare, network_family
from asia.models._networks.structure import Features, Params, zeros
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData
from asia.models.autoregressive import AutoregressiveCell, FeedbackState, increment_sizes

__all__ = ["Config", "NetworkModel", "build", "train"]


@dataclass(frozen=True)
class Config(autoregressive.Config):
    """Settings of `asia.models.autoregressive`."""


@dataclass(frozen=True)
class KinematicCell(AutoregressiveCell):
    """Structure of the network: see `Cell` and `OutputFeedback` in
    `asia.models._networks.structure`."""

    config: Config
    past: int = 0
    """Number of output samples in the past window."""

    @classmethod
    def of(cls, config: autoregressive.Config, context: Context) -> KinematicCell:
        """Structure for a problem.

        Raises:
            UserError: if there is only one output.
        """
        assert isinstance(config, Config)
        if context.ny < 2:
            raise _no_rates()
        past, drive = context.n_past_y, Features(config.features)
        return cls(config, context.ny, past > 0, past=past, drive=drive)

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare:
        """Take the kinematics from the records.

        Raises:
            UserError: if no output is the integral of another.
        """
        rates = find_rates(trajectories, context)
        if not rates:
            raise _no_rates()
        # An integrated output that no equation reads, such as a position, leaves the forces alike.
        integrated, needed = {r.output for r in rates}, read_by_equations(context)
        read = [j in needed or j not in integrated for j in range(context.ny)]

        def with_kinematics(params: Params, records: ScaledData, scaling: Scaling) -> Params:
            """Add the kinematics in z-scores and the size of the other increments."""
            ny, increment = context.ny, increment_sizes(records)
            rate, drift = np.zeros((ny, ny)), np.zeros(ny)
            for r in rates:
                increment[r.output] = 0.0
                moved = r.gain * context.sampling_time / scaling.y_std[r.output]
                rate[r.rate, r.output] = moved * scaling.y_std[r.rate]
                drift[r.output] = moved * scaling.y_mean[r.rate]
            fixed = {"increment": increment, "read": np.array(read), "rate": rate, "drift": drift}
            return {**params, "fixed": {k: np.asarray(v, np.float32) for k, v in fixed.items()}}

        return with_kinematics

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`: the output is held."""
        ny = context.ny
        return {
            **super().parameters(context),
            "gain": zeros(ny),
            "fixed": {
                "increment": np.ones(ny, np.float32),
                "read": np.ones(ny, np.float32),
                "rate": zeros(ny, ny),
                "drift": zeros(ny),
            },
        }

    def initial(self, params: Any, window: AnyArray) -> FeedbackState:
        """Layers' states and the last measured output, its mean where none is given."""
        _, y = super().initial(params, window)
        read = params["fixed"]["read"]
        inputs = np.ones(window.shape[1] - self.past * self.ny, window.dtype)
        seen = namespace(read).concatenate([inputs, *[read] * self.past])
        return self.inner.initial(params["net"], window * seen), y

    def step(
        self, params: Any, state: FeedbackState, u: AnyArray
    ) -> tuple[FeedbackState, AnyArray]:
        """Advance by one sample; the features are the output."""
        inner, y = state
        fixed = params["fixed"]
        xp = namespace(u, y)
        drive = xp.concatenate([self.drive(u), y * fixed["read"]], axis=-1)
        inner, h = self.inner.step(params["net"], inner, drive)
        moved = fixed["increment"] * (h @ params["out_w"] + params["out_b"])
        integrated = (1 + params["gain"]) * (y @ fixed["rate"] + fixed["drift"])
        y = y + moved + integrated
        return (inner, y), y


def _no_rates() -> UserError:
    return UserError(
        "kinematic: no output is the integral of another, in [physics] or in the training records; "
        "use autoregressive"
    )


build, train = network_family(Config, KinematicCell)
