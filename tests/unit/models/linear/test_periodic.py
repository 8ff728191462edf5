"""Linear systems from the lines of periodic records, and one for each level of excitation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import groups_by_level, running_levels, shares
from asia.models._linear.periodic import (
    error,
    in_blocks,
    lines_of,
    observability,
    refined,
    resolvent,
    steady_records,
    with_inputs,
)
from asia.models._linear.system import LinearSystem
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled

PERIOD, CHANNELS = 512, 3
SIGNALS = [tuple(Signal(f"{name}{k}", "V") for k in range(CHANNELS)) for name in "uy"]


def context() -> Context:
    return Context(SIGNALS[0], SIGNALS[1], 1.0, n_past_u=30, n_past_y=30)


def system(shift: float = 0.0) -> LinearSystem:
    """Three modes of 3 inputs and 3 outputs; `shift` moves their frequencies."""
    rng = np.random.default_rng(0)
    a = np.zeros((6, 6))
    for k, (radius, angle) in enumerate(((0.97, 0.4), (0.95, 1.0), (0.9, 1.9))):
        x, y = radius * np.cos(angle + shift), radius * np.sin(angle + shift)
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[x, y], [-y, x]]
    b, c = rng.standard_normal((6, CHANNELS)), rng.standard_normal((CHANNELS, 6))
    return LinearSystem(a, b, c, np.zeros((CHANNELS, CHANNELS)), np.ones(CHANNELS))


def multisine(rng: np.random.Generator) -> Array:
    lines = np.zeros((PERIOD // 2 + 1, CHANNELS), complex)
    lines[1:230] = np.exp(2j * np.pi * rng.random((229, CHANNELS)))
    u = np.fft.irfft(lines, PERIOD, axis=0)
    return u / u.std(axis=0)


def record(truth: LinearSystem, level: float, seed: int, noise: float = 0.02) -> Trajectory:
    """Two periods in steady state."""
    rng = np.random.default_rng(seed)
    u = np.tile(level * multisine(rng), (6, 1))
    y = truth.simulate(np.zeros((1, 6)), u[None])[1][0][-2 * PERIOD :]
    size = level * noise * y.std() / level
    y = y + size * rng.standard_normal(y.shape)
    return Trajectory(u[-2 * PERIOD :], y, 1.0, f"{level}-{seed}")


def records(level: float = 1.0, shift: float = 0.0, first: int = 0) -> list[Trajectory]:
    return [record(system(shift), level, first + seed) for seed in range(4)]


def fitted(config: linear.Config, data: Sequence[Trajectory]) -> linear.LinearStateSpace:
    model = linear.build(config, context())
    return linear.train(model, data, context(), LevenbergMarquardt(iterations=5))


def share_left(model: linear.LinearStateSpace, data: Sequence[Trajectory]) -> float:
    """Root of the mean squared error over that of the mean."""
    past, left, whole = 30, 0.0, 0.0
    for r in data:
        found = model.simulate(r.u[None, :past], r.y[None, :past], r.u[None, past:])[0]
        left += float(((found - r.y[past:]) ** 2).sum())
        whole += float(((r.y[past:] - r.y.mean(axis=0)) ** 2).sum())
    return float(np.sqrt(left / whole))


@pytest.mark.slow
def test_order_and_response_of_three_by_three_are_found_from_lines() -> None:
    model = fitted(linear.Config(periodic=True), records())
    assert model.fitted is not None
    assert model.fitted.system.order == 6
    poles = np.sort_complex(np.linalg.eigvals(model.fitted.system.a))
    assert poles == pytest.approx(np.sort_complex(np.linalg.eigvals(system().a)), abs=2e-3)
    assert share_left(model, records(first=50)) < 0.025


@pytest.mark.long
def test_records_without_a_period_are_fitted_as_before() -> None:
    rng = np.random.default_rng(3)
    u = rng.standard_normal((300, CHANNELS))
    y = system().simulate(np.zeros((1, 6)), u[None])[1][0]
    data = [Trajectory(u, y, 1.0, "noise")]
    plain, asked = (fitted(linear.Config(order=2, periodic=p), data) for p in (False, True))
    assert plain.fitted is not None
    assert asked.fitted is not None
    assert np.array_equal(plain.fitted.system.a, asked.fitted.system.a)


def test_a_transient_is_no_steady_state() -> None:
    u = np.tile(multisine(np.random.default_rng(0)), (2, 1))
    y = system().simulate(np.full((1, 6), 300.0), u[None])[1][0]
    still = Trajectory(u, y, 1.0, "transient")
    assert steady_records(scaled([still], Scaling.of([still]))) is None


def test_refinement_of_lines_reaches_the_truth_from_a_disturbed_start() -> None:
    data = [record(system(), 1.0, seed, noise=0.0) for seed in range(4)]
    found = steady_records(scaled(data, Scaling.of(data)))
    assert found is not None
    lines = lines_of(found)
    pair = in_blocks(*known) if (known := observability(lines, 6).shifted(6)) else None
    assert pair is not None
    start = with_inputs(lines, 0.99 * pair[0], pair[1])
    assert error(lines, start) > 1e-3 * float((abs(lines.y) ** 2).sum())
    end = refined(lines, start, LevenbergMarquardt(40, damping=1e-3, tolerance=0.0))
    assert error(lines, end) < 1e-12 * float((abs(lines.y) ** 2).sum())


def test_blocks_keep_real_and_outer_poles() -> None:
    a = np.diag([0.5, -0.2, 1.25])
    found = in_blocks(a, np.ones((1, 3)))
    assert found is not None
    assert np.sort(np.linalg.eigvals(found[0]).real) == pytest.approx([-0.2, 0.5, 0.8])
    z = np.exp(1j * np.array([0.3, 2.0]))
    full = np.stack([np.linalg.solve(v * np.eye(3) - found[0], np.ones((3, 1))) for v in z])
    assert resolvent(found[0], z, np.ones((3, 1))) == pytest.approx(full)


@pytest.mark.long
def test_a_system_for_each_level_is_far_better_where_they_differ() -> None:
    data = [*records(1.0), *records(2.0, shift=0.03, first=10)]
    fresh = [*records(1.0, first=50), *records(2.0, shift=0.03, first=60)]
    one = fitted(linear.Config(periodic=True), data)
    each = fitted(linear.Config(periodic=True, levels=True), data)
    assert each.by_level is not None
    assert len(each.by_level.systems) == 2
    assert share_left(each, fresh) < 0.3 * share_left(one, fresh)
    assert "frequency 1 [1/sample], level 2" in each.parameters()


def test_levels_of_records_that_are_alike_are_one_system() -> None:
    model = fitted(linear.Config(order=6, periodic=True, levels=True), records())
    assert model.by_level is None
    assert model.fitted is not None


def test_groups_by_level() -> None:
    unit = np.ones((10, 2))
    assert groups_by_level([3 * unit, unit, 1.1 * unit, 3.3 * unit]) == [[1, 2], [0, 3]]


def test_running_levels_forget_and_do_not_look_ahead() -> None:
    u = np.array([1.0, 1.0, 3.0, 3.0])[None, :, None]
    found = running_levels(np.full((1, 1, 1), 5.0), u, memory=2)
    assert found[0] == pytest.approx(np.sqrt([13.0, 1.0, 5.0, 9.0]))
    assert shares(np.array([1.0, 3.0]), np.array([[0.0, 1.5, 9.0]]))[0] == pytest.approx(
        np.array([[1.0, 0.0], [0.75, 0.25], [0.0, 1.0]])
    )
