"""Levenberg-Marquardt against SciPy and on its promises."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from asia.errors import UserError
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.minimise import Minimum, NormalEquations, minimise

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
