"""Conformance suite for metrics."""

from typing import get_args

import numpy as np

from asia.data.trajectory import Array
from asia.problem.metrics import Metric, TrainingLoss


def check_metric(metric: Metric) -> None:
    """Compute the metric on made-up trajectories.

    Checked: one finite number an output; the best value, and only there, where the simulation
    equals the measurement; worse values for larger errors, in the declared direction; each output
    by itself; the order of the trajectories changes nothing; a value in the unit of the output
    grows with that unit, one without a unit or in percent does not; the arrays given are left as
    they are.

    Raises:
        AssertionError: that says what fails
    """
    assert metric.name.isidentifier(), f"the name {metric.name!r} is no identifier"
    assert metric.label.strip() == metric.label != "", "a label is a word or a few"
    losses = get_args(TrainingLoss)
    assert metric.loss in losses, f"loss is {metric.loss!r}, expected one of {losses}"
    assert metric.direction in ("lower", "higher"), f"direction is {metric.direction!r}"
    assert np.isfinite(metric.best), "best is not finite"
    assert metric.direction == "higher" or metric.best == 0.0, "a perfect simulation has error 0"
    for outputs in (1, 3):
        _check_values(metric, outputs)


def _check_values(metric: Metric, outputs: int) -> None:
    random = np.random.default_rng(outputs)
    parts = [random.normal(size=(n, outputs)).cumsum(axis=0) for n in (40, 70, 30)]
    y, scale = np.concatenate(parts), np.ones(outputs)
    noise = random.normal(size=y.shape)
    y_hat = y + 0.3 * noise
    given = y.copy(), y_hat.copy()
    values = metric.values(y, y_hat)
    unchanged = all(np.array_equal(a, b) for a, b in zip(given, (y, y_hat), strict=True))
    assert unchanged, "the arrays given were changed"
    assert np.isfinite(values).all(), f"{values} is not finite"
    assert np.allclose(metric.values(y, y.copy()), metric.best), "another value than best at y"
    near, far = (metric.shortfall(y, y + size * noise, scale) for size in (0.3, 3.0))
    assert 0.0 <= near <= far, "a larger error has a better value: direction?"
    assert far > 0.0, "a large error has the best value"
    for channel in range(outputs):
        alone = metric.values(y[:, [channel]], y_hat[:, [channel]])
        assert np.allclose(alone, values[channel]), "an output's value depends on the others"
    other = np.concatenate(np.split(np.arange(len(y)), (40, 110))[::-1])
    assert _same(metric.values(y[other], y_hat[other]), values), "the order of trajectories counts"
    if metric.unit in ("signal", "", "%"):
        factor = 10.0 if metric.normalised else 1.0
        message = f"not in the unit {metric.unit!r}: measured in another unit it does not follow"
        assert _same(metric.values(10.0 * y, 10.0 * y_hat), factor * values), message


def _same(a: Array, b: Array) -> bool:
    return bool(np.allclose(a, b, rtol=1e-9))
