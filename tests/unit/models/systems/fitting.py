"""Common helpers of the tests of input-output families: fitting, reloading, a windows problem."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from tests.unit.models.systems.black_box import Case


def rectifying(u: Array) -> Array:
    """A lag driven by the input and its modulus, that leaks more when full: what every family is
    compared with the best linear model on."""
    y = np.zeros((len(u), 1))
    for k in range(1, len(u)):
        y[k] = 0.7 * y[k - 1] + 0.3 * u[k - 1] + 0.4 * np.abs(u[k - 1]) - 0.05 * y[k - 1] ** 2
    return y


def fitted(module: Any, config: Any, data: Case, method: Any) -> Any:
    return module.train(module.build(config, data.context), data.training, data.context, method)


def short_past(data: Case) -> Case:
    """Past windows shorter than any lag: no inputs, one output."""
    return replace(data, context=replace(data.context, n_past_u=0, n_past_y=1))


def from_short_past(model: Any, data: Case) -> Array:
    u, y = data.unseen.u, data.unseen.y
    return model.simulate(u[None, :0], y[None, :1], u[None, 1:])[0]


def flight(runs: int = 4, length: int = 300) -> tuple[list[Trajectory], Context]:
    """Position, its velocity and a third state, judged over 25 samples from one measured state."""
    rng, found = np.random.default_rng(0), list[Trajectory]()
    for i in range(runs):
        u = np.repeat(rng.standard_normal((length // 5, 2)), 5, axis=0)
        y = np.zeros((length, 3))
        y[0] = rng.standard_normal(3)
        for k in range(1, length):
            p, v, w = y[k - 1]
            force = np.tanh(2 * u[k, 0]) - 0.8 * v - p - 0.5 * p**3 + 0.3 * w
            turn = u[k, 1] - 0.7 * w * (1 + 0.3 * p)
            y[k] = [p + 0.05 * v, v + 0.05 * force, w + 0.05 * turn]
        found.append(Trajectory(u, y + 0.002 * rng.standard_normal(y.shape), 0.05, f"run{i}"))
    context = Context(
        (Signal("u1"), Signal("u2")),
        (Signal("p"), Signal("v"), Signal("w")),
        0.05,
        n_past_u=0,
        n_past_y=1,
        horizon=25,
        metric="mae",
        seed=1,
    )
    return found, context


def against_holding(module: Any, config: Any, method: Any, runs: int = 4) -> float:
    """Mean absolute error over windows of the last run, over that of the last state held."""
    records, context = flight(runs)
    model = module.train(module.build(config, context), records[:-1], context, method)
    last = records[-1]
    starts = np.arange(1, len(last) - 25, 25)
    rows = starts[:, None] + np.arange(25)
    past = last.y[starts - 1][:, None]
    y_hat = model.simulate(np.zeros((len(starts), 0, 2)), past, last.u[rows])
    assert y_hat.shape == (len(starts), 25, 3)
    assert np.isfinite(y_hat).all()
    size = last.y.std(axis=0)
    return float((np.abs(y_hat - last.y[rows]) / size).mean()) / float(
        (np.abs(past - last.y[rows]) / size).mean()
    )
