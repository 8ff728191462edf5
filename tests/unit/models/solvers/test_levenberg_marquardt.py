"""Levenberg-Marquardt against SciPy and on its promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

from asia.errors import UserError
from asia.models._arrays import namespace
from asia.models._least_squares import (
    SEQUENTIAL,
    SIDE_BY_SIDE,
    DampingSchedule,
    LevenbergMarquardt,
    Minimum,
    NormalEquations,
    minimise,
    solve,
    traced_minimum,
)

Function = Callable[[Any], Any]


def rosenbrock(theta: Any) -> Any:
    return np.stack([10.0 * (theta[1] - theta[0] ** 2), 1.0 - theta[0]])


def by_steps(residual: Function) -> Function:
    """The Jacobian by complex steps, exact for analytic functions."""

    def jacobian(theta: Any) -> Any:
        moved = theta + 1e-30j * np.eye(len(theta))
        return np.stack([np.imag(residual(row)) / 1e-30 for row in moved], axis=1)

    return jacobian


def solved(
    residual: Function,
    starts: Any,
    method: LevenbergMarquardt | None = None,
    jacobian: Function | None = None,
) -> Minimum:
    derivative = jacobian or by_steps(residual)

    def costs(points: Any) -> Any:
        return np.array([[np.sum(residual(point) ** 2) for point in row] for row in points])

    def linearise(thetas: Any) -> NormalEquations:
        pairs = [(residual(theta), derivative(theta)) for theta in thetas]
        rows = [(e @ e, j.T @ j, j.T @ e) for e, j in pairs]
        return NormalEquations(*(np.stack(part) for part in zip(*rows, strict=True)))

    return minimise(costs, linearise, np.array(starts), method or LevenbergMarquardt())


def decay_problem() -> tuple[np.ndarray, np.ndarray]:
    time = np.linspace(0.0, 4.0, 60)
    noise = np.random.default_rng(0).normal(scale=0.05, size=60)
    return time, 3.0 * np.exp(-0.8 * time) + 0.5 + noise


def test_reaches_the_minimum_of_rosenbrock() -> None:
    result = solved(rosenbrock, [[-1.2, 1.0]], LevenbergMarquardt(iterations=100))
    np.testing.assert_allclose(result.theta, [[1.0, 1.0]], atol=1e-8)


def test_agrees_with_scipy_on_a_noisy_exponential() -> None:
    time, data = decay_problem()

    def residual(theta: Any) -> Any:
        return theta[0] * np.exp(-theta[1] * time) + theta[2] - data

    ours = solved(residual, [[1.0, 0.1, 0.0]])
    reference = least_squares(residual, [1.0, 0.1, 0.0], xtol=1e-12)
    np.testing.assert_allclose(ours.theta[0], reference.x, rtol=1e-5)
    np.testing.assert_allclose(ours.cost[0], 2 * reference.cost, rtol=1e-9)


def test_a_row_is_minimised_as_it_is_alone() -> None:
    method = LevenbergMarquardt(iterations=200)
    starts = np.random.default_rng(1).normal(size=(6, 2))
    result = solved(rosenbrock, starts, method)
    np.testing.assert_allclose(result.theta, np.ones((6, 2)), atol=1e-6)
    alone = [solved(rosenbrock, start[None], method) for start in starts]
    np.testing.assert_array_equal(result.theta, np.concatenate([one.theta for one in alone]))
    np.testing.assert_array_equal(result.history, np.concatenate([one.history for one in alone]))


def test_rows_far_behind_the_best_are_given_up() -> None:
    starts, method = np.array([[1.1, 1.2], [-1.2, 1.0]]), LevenbergMarquardt(iterations=100)
    asked: list[int] = []

    def costs(points: Any) -> Any:
        asked.append(int((points[1] != points[1, :1]).any()))
        return np.array([[np.sum(rosenbrock(point) ** 2) for point in row] for row in points])

    def linearise(thetas: Any) -> NormalEquations:
        pairs = [(rosenbrock(theta), by_steps(rosenbrock)(theta)) for theta in thetas]
        rows = [(e @ e, j.T @ j, j.T @ e) for e, j in pairs]
        return NormalEquations(*(np.stack(part) for part in zip(*rows, strict=True)))

    free = minimise(costs, linearise, starts, method)
    assert free.cost[1] < 1e-6
    asked.clear()
    raced = minimise(costs, linearise, starts, method, race=((3, 2.0),))
    assert raced.cost[1] > 0.01
    assert raced.history[1, 3] == raced.cost[1]
    assert asked[:3] == [1, 1, 1]
    assert not any(asked[3:])
    np.testing.assert_array_equal(raced.theta[0], free.theta[0])


def test_cost_never_rises_and_history_ends_at_the_cost() -> None:
    result = solved(rosenbrock, [[-3.0, 5.0]], LevenbergMarquardt(iterations=30))
    assert (np.diff(result.history) <= 0).all()
    assert result.history[0, -1] == result.cost[0]


def test_no_iterations_give_the_cost_of_the_start() -> None:
    result = solved(rosenbrock, [[-1.2, 1.0]], LevenbergMarquardt(iterations=0))
    np.testing.assert_array_equal(result.theta, [[-1.2, 1.0]])
    np.testing.assert_allclose(result.cost, [(rosenbrock(np.array([-1.2, 1.0])) ** 2).sum()])


def test_steps_into_values_that_are_not_finite_are_refused() -> None:
    def residual(theta: Any) -> Any:
        return np.where(theta.real > 0, np.log(np.where(theta.real > 0, theta, 1.0)) + 3.0, np.nan)

    result = solved(residual, [[5.0]])
    np.testing.assert_allclose(result.theta, [[np.exp(-3.0)]], rtol=1e-6)


def test_the_given_normal_equations_are_used() -> None:
    right, start = by_steps(rosenbrock), [[-1.2, 1.0]]
    wrong = solved(rosenbrock, start, LevenbergMarquardt(iterations=1), lambda t: -right(t))
    np.testing.assert_array_equal(wrong.theta, start)


def test_a_parameter_without_effect_stays_where_it_was() -> None:
    result = solved(lambda t: t[:1] - 2.0, [[0.0, 7.0]])
    np.testing.assert_allclose(result.theta, [[2.0, 7.0]], atol=1e-9)


@pytest.mark.parametrize(
    "arguments", [{"iterations": -1}, {"starts": 0}, {"damping": 0.0}, {"tolerance": -1.0}]
)
def test_settings_out_of_range_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(UserError, match="LevenbergMarquardt"):
        LevenbergMarquardt(**arguments)


def test_an_unknown_way_to_stop_is_refused() -> None:
    with pytest.raises(UserError, match="expected None or 'validation'"):
        LevenbergMarquardt(stop="inner")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_row_that_is_not_finite_leaves_the_others_alone(lost: float) -> None:
    def costs(points: np.ndarray) -> np.ndarray:
        return ((points - 2.0) ** 2).sum(axis=2) * np.array([[1.0], [lost]])

    def linearise(theta: np.ndarray) -> NormalEquations:
        gram = np.stack([np.eye(2), np.full((2, 2), lost)])
        pull = (theta - 2.0) * np.array([[1.0], [lost]])
        return NormalEquations(costs(theta[:, None])[:, 0], gram, pull)

    found = minimise(costs, linearise, np.zeros((2, 2)), LevenbergMarquardt())
    np.testing.assert_allclose(found.theta, [[2.0, 2.0], [0.0, 0.0]], atol=1e-9)
    assert found.cost[1] == np.inf


def bowl(asked: list[float] | None = None) -> tuple[Function, Function]:
    """Costs and normal equations of rows whose Jacobian is a tenth of the right one, so that every
    undamped step is ten times too long."""

    def costs(points: Any) -> Any:
        if asked is not None:
            asked.append(float(points[0, 0, 0]))
        return ((points - 2.0) ** 2).sum(axis=2)

    def linearise(theta: Any) -> NormalEquations:
        gram = 0.1 * np.broadcast_to(np.eye(2), (len(theta), 2, 2))
        return NormalEquations(((theta - 2.0) ** 2).sum(axis=1), gram, theta - 2.0)

    return costs, linearise


def test_a_sequential_search_raises_the_damping_until_a_step_is_taken() -> None:
    asked = list[float]()
    costs, linearise = bowl(asked)
    one = LevenbergMarquardt(iterations=1, damping=1e-2)
    found = minimise(costs, linearise, np.zeros((1, 2)), one, SEQUENTIAL)
    # Steps of 20 / (1 + damping), for dampings of 0.01, 0.08, 0.64, 5.12: the fourth lowers it.
    np.testing.assert_allclose(asked, [20 / (1 + 0.01 * 8**k) for k in range(4)])
    assert found.cost[0] < 8.0


def test_a_schedule_without_retries_asks_once_for_each_jacobian() -> None:
    asked = list[float]()
    costs, linearise = bowl(asked)
    schedule = DampingSchedule((1.0,), 0.2, 10.0, 0.0, float("inf"), retries=False)
    method = LevenbergMarquardt(iterations=3, damping=1e-2)
    found = minimise(costs, linearise, np.zeros((1, 2)), method, schedule)
    np.testing.assert_allclose(asked, [20 / (1 + 0.01 * 10**k) for k in range(3)])
    np.testing.assert_array_equal(found.history, np.full((1, 4), 8.0))


def test_patience_counts_iterations_of_little_gain_in_a_row() -> None:
    costs, linearise = bowl()
    # Of a cost of 1000, which no step can lower by more than 8.
    big = (
        (lambda p: costs(p) + 992.0),
        (lambda t: linearise(t)._replace(cost=linearise(t).cost + 992.0)),
    )
    method = LevenbergMarquardt(iterations=20, damping=10.0, tolerance=0.05)
    counts = list[int]()
    for patience in (1, 2, 3):
        calls = list[float]()
        minimise(
            *big, np.zeros((1, 2)), method, SEQUENTIAL, patience=patience,
            after=lambda theta, cost, calls=calls: calls.append(float(cost[0])),
        )  # fmt: skip
        counts.append(len(calls))
    assert counts == [1, 2, 3]


@pytest.mark.parametrize("schedule", [SIDE_BY_SIDE, replace(SEQUENTIAL, retries=False)])
def test_the_traced_loop_is_the_same(schedule: DampingSchedule) -> None:
    """One row, whose loop JAX compiles."""

    def costs(points: Any) -> Any:
        return residuals(points).__pow__(2).sum(axis=2)

    def residuals(t: Any) -> Any:
        xp = namespace(t)
        return xp.stack([10.0 * (t[..., 1] - t[..., 0] ** 2), 1.0 - t[..., 0]], axis=-1)

    def linearise(t: Any) -> NormalEquations:
        e, xp = residuals(t), namespace(t)
        zero, one = xp.zeros(len(t)), xp.ones(len(t))
        j = xp.stack([-20.0 * t[:, 0], 10.0 * one, -one, zero], axis=1).reshape(-1, 2, 2)
        turned = j.swapaxes(1, 2)
        return NormalEquations((e**2).sum(axis=1), turned @ j, (turned @ e[..., None])[..., 0])

    method, start = LevenbergMarquardt(iterations=25), np.array([[-1.2, 1.0], [0.3, 0.1]])
    with jax.enable_x64(True):
        traced = jax.jit(lambda t: traced_minimum(costs, linearise, t, method, schedule))(start)
    expected = minimise(costs, linearise, start, method, schedule)
    assert expected.history[0, -1] < 0.2 * expected.history[0, 0]
    np.testing.assert_allclose(np.asarray(traced), expected.theta, rtol=1e-9, atol=1e-12)


def test_a_singular_row_leaves_the_others_alone() -> None:
    matrices = np.stack([np.diag([2.0, 4.0]), np.ones((2, 2)), np.full((2, 2), np.inf)])
    with np.errstate(all="ignore"):
        found = solve(matrices, np.array([[2.0, 4.0], [2.0, 2.0], [1.0, 1.0]]))
    np.testing.assert_allclose(found[:2], 1.0)
    assert np.isnan(found[2]).all()
