"""Families that start from equations or from kinematics, on a generated pendulum.

    python benchmarks/models/families_physics.py [--seeds 0 1 2]

The grey-box gets the pendulum's own equations with unknown parameters; hybrid and physics_net get
them without the drag that the pendulum has, which they must learn. All three are judged on fresh
noisy records: simulation error over that of the true equations from the same start, 1 at best, at
most 1.2 wanted. The kinematic network gets no equations: its error against the noise-free truth is
taken over that of the best linear model, at most 0.5 wanted. Equations with measured states and the
kinematic network simulate windows of 50 samples from one measured sample, the others whole records.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context, Model
from asia.data import Signal, Trajectory
from asia.models import greybox, hybrid, kinematic, linear, physics_net
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import Adam
from asia.problem import ParameterRange, Physics

Array = NDArray[np.float64]

DT, SAMPLES, HORIZON, PAST, NOISE = 0.05, 1000, 50, 10, 0.05
PULL, DRAG, FRICTION, GAIN = 9.0, 1.0, 0.5, 4.0
EQUATIONS = Physics(
    states=("angle", "rate"),
    dynamics={"angle": "rate", "rate": "-pull*sin(angle) - drag*rate + gain*u"},
    parameters={
        "pull": ParameterRange(1.0, 50.0),
        "drag": ParameterRange(0.01, 5.0),
        "gain": ParameterRange(0.1, 50.0),
    },
)


@dataclass(frozen=True)
class Row:
    """A family with its settings; friction: of the quadratic kind, which EQUATIONS do not have;
    windows: whether windows or whole records are simulated; own: whether it is compared with the
    truth, else with the best linear model; torque: standard deviation of the input."""

    module: ModuleType
    config: Any
    method: Any
    friction: float
    windows: bool
    own: bool = True
    torque: float = 0.6


ROWS = (
    Row(greybox, greybox.Config(), LevenbergMarquardt(60, starts=4), 0.0, windows=False),
    Row(
        hybrid, hybrid.Config(units=4, ridge=1e-3), LevenbergMarquardt(60, starts=4), FRICTION,
        windows=False,
    ),
    Row(
        physics_net, physics_net.Config(network="mlp", lag=False, linear=True),
        Adam(600, 3e-3, batch=16), FRICTION, windows=True,
    ),
    Row(
        kinematic, kinematic.Config(cell="gru", hidden=32), Adam(3000, 3e-3, batch=32), FRICTION,
        windows=True, own=False, torque=1.5,
    ),
)  # fmt: skip


def swing(x: Array, u: Array, friction: float) -> Array:
    """States (B, T, 2) of the true pendulum after each input (B, T), from x (B, 2)."""

    def rates(x: Array, torque: Array) -> Array:
        drag = DRAG * x[:, 1] + friction * x[:, 1] * np.abs(x[:, 1])
        return np.stack([x[:, 1], -PULL * np.sin(x[:, 0]) - drag + GAIN * torque], axis=1)

    found = np.empty((*u.shape, 2))
    for k in range(u.shape[1]):
        for _ in range(4):
            middle = x + 0.5 * DT / 4 * rates(x, u[:, k])
            x = x + DT / 4 * rates(middle, u[:, k])
        found[:, k] = x
    return found


@dataclass(frozen=True)
class Data:
    """Noisy records, to train on and fresh; truth: what the fresh one is without noise."""

    training: list[Trajectory]
    fresh: Trajectory
    truth: Array


def draw(row: Row, seed: int) -> Data:
    """Torques held for ten samples, white noise of NOISE times the
    deviation of each output."""
    rng = np.random.default_rng(seed)
    u = np.repeat(row.torque * rng.standard_normal((4, SAMPLES // 10)), 10, axis=1)
    truth = swing(np.zeros((4, 2)), u, row.friction)
    if not row.windows:
        # A record's output is the state as an input starts to act, a window's what it has led to.
        truth = np.concatenate([np.zeros((4, 1, 2)), truth[:, :-1]], axis=1)
    size = NOISE * truth.std(axis=(0, 1))
    y = truth + size * rng.standard_normal(truth.shape)
    records = [Trajectory(a[:, None], b, DT) for a, b in zip(u, y, strict=True)]
    return Data(records[:3], records[3], truth[3])


def cases(data: Data, row: Row) -> tuple[Array, Array, Array, Array, Array]:
    """Past inputs and outputs, inputs, measured and true outputs of the fresh record."""
    u, y = data.fresh.u, data.fresh.y
    if not row.windows:
        past_u, past_y = u[None, :PAST], y[None, :PAST]
        return past_u, past_y, u[None, PAST:], y[None, PAST:], data.truth[None, PAST:]
    starts = range(1, len(u) - HORIZON, HORIZON)
    cut = [slice(k, k + HORIZON) for k in starts]
    past = np.stack([y[k - 1 : k] for k in starts])
    return (
        np.empty((len(past), 0, 1)), past, np.stack([u[c] for c in cut]),
        np.stack([y[c] for c in cut]), np.stack([data.truth[c] for c in cut]),
    )  # fmt: skip


def figure(row: Row, seed: int) -> float:
    """Error over that of the true equations, or of the best linear model."""
    data = draw(row, seed)
    context = Context(
        (Signal("u"),), (Signal("angle"), Signal("rate")), DT, PAST, PAST, physics=EQUATIONS, seed=1
    )
    if row.windows:
        context = replace(context, n_past_u=0, n_past_y=1, horizon=HORIZON)
    past_u, past_y, u, y, truth = cases(data, row)
    if row.own:
        model = _fit(row.module, row.config, row.method, data, context)
        floor = swing(past_y[:, -1], u[..., 0], row.friction) if row.windows else truth
        return _error(model.simulate(past_u, past_y, u), y) / _error(floor, y)
    context = replace(context, physics=None)
    model = _fit(row.module, row.config, row.method, data, context)
    line = _fit(linear, linear.Config(), LevenbergMarquardt(30), data, context)
    found, best = (_error(m.simulate(past_u, past_y, u), truth) for m in (model, line))
    return found / best


def _fit(module: ModuleType, config: Any, method: Any, data: Data, context: Context) -> Model:
    return module.train(module.build(config, context), data.training, context, method)


def _error(a: Array, b: Array) -> float:
    """Root mean square, each output over its own deviation."""
    return float(np.sqrt(np.mean(((a - b) / b.std(axis=(0, 1))) ** 2)))


def main() -> None:
    """Print the table, medians over the seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    print("| family | against | median | worst | wanted | s a fit |")
    print("|---|---|---|---|---|---|")
    for row in ROWS:
        start = time.monotonic()
        values = [figure(row, seed) for seed in options.seeds]
        seconds = (time.monotonic() - start) / len(values)
        against, wanted = ("true equations", 1.2) if row.own else ("linear", 0.5)
        print(
            f"| {row.module.__name__.rpartition('.')[2]} | {against} | {np.median(values):.3f} | "
            f"{max(values):.3f} | {wanted} | {seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
