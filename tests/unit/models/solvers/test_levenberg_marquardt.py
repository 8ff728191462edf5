"""Levenberg-Marquardt against SciPy and on its promises."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from asia.errors import UserError
from asia.models._solvers.levenberg_marquardt import LevenbergMarquardt, levenberg_marquardt


def rosenbrock(theta: jax.Array) -> jax.Array:
    return jnp.stack([10.0 * (theta[1] - theta[0] ** 2), 1.0 - theta[0]])


def decay_problem() -> tuple[np.ndarray, np.ndarray]:
    time = np.linspace(0.0, 4.0, 60)
    noise = np.random.default_rng(0).normal(scale=0.05, size=60)
    return time, 3.0 * np.exp(-0.8 * time) + 0.5 + noise


def test_reaches_the_minimum_of_rosenbrock() -> None:
    result = levenberg_marquardt(
        rosenbrock, jnp.array([-1.2, 1.0]), LevenbergMarquardt(iterations=100)
    )
    np.testing.assert_allclose(result.theta, [1.0, 1.0], atol=1e-8)
    assert result.theta.dtype == np.float64


def test_agrees_with_scipy_on_a_noisy_exponential() -> None:
    time, data = decay_problem()

    def model(theta, exp):
        return theta[0] * exp(-theta[1] * time) + theta[2] - data

    ours = levenberg_marquardt(
        lambda t: model(t, jnp.exp), jnp.array([1.0, 0.1, 0.0]), LevenbergMarquardt()
    )
    reference = least_squares(lambda t: model(t, np.exp), [1.0, 0.1, 0.0], xtol=1e-12)
    np.testing.assert_allclose(ours.theta, reference.x, rtol=1e-5)
    np.testing.assert_allclose(ours.cost, 2 * reference.cost, rtol=1e-9)


def test_many_starts_under_jit_and_vmap_find_the_same_minimum() -> None:
    method = LevenbergMarquardt(iterations=200)
    starts = np.random.default_rng(1).normal(size=(6, 2))
    with jax.enable_x64(True):
        run = jax.jit(jax.vmap(lambda t: levenberg_marquardt(rosenbrock, t, method)))
        result = run(jnp.asarray(starts))
    np.testing.assert_allclose(result.theta, np.ones((6, 2)), atol=1e-6)


def test_cost_never_rises_and_history_ends_at_the_cost() -> None:
    result = levenberg_marquardt(
        rosenbrock, jnp.array([-3.0, 5.0]), LevenbergMarquardt(iterations=30)
    )
    assert (np.diff(result.history) <= 0).all()
    assert result.history[-1] == result.cost


def test_steps_into_values_that_are_not_finite_are_refused() -> None:
    def residual(theta: jax.Array) -> jax.Array:
        return jnp.where(theta > 0, jnp.log(theta) + 3.0, jnp.nan)

    result = levenberg_marquardt(residual, jnp.array([5.0]), LevenbergMarquardt())
    np.testing.assert_allclose(result.theta, [np.exp(-3.0)], rtol=1e-6)


def test_a_given_jacobian_is_used() -> None:
    def wrong_by_sign(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        return rosenbrock(theta), -jax.jacfwd(rosenbrock)(theta)

    start = jnp.array([-1.2, 1.0])
    result = levenberg_marquardt(rosenbrock, start, LevenbergMarquardt(iterations=1), wrong_by_sign)
    np.testing.assert_array_equal(result.theta, start)


def test_a_parameter_without_effect_stays_where_it_was() -> None:
    result = levenberg_marquardt(lambda t: t[:1] - 2.0, jnp.array([0.0, 7.0]), LevenbergMarquardt())
    np.testing.assert_allclose(result.theta, [2.0, 7.0], atol=1e-9)


@pytest.mark.parametrize(
    "arguments", [{"iterations": -1}, {"starts": 0}, {"damping": 0.0}, {"tolerance": -1.0}]
)
def test_settings_out_of_range_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(UserError, match="LevenbergMarquardt"):
        LevenbergMarquardt(**arguments)


def test_an_unknown_way_to_stop_is_refused() -> None:
    with pytest.raises(UserError, match="expected None or 'validation'"):
        LevenbergMarquardt(stop="inner")  # pyright: ignore[reportArgumentType]
