"""Functions made of the person's expressions."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.models._arrays import AnyArray
from asia.models._equations.ode import Equations, equations, runge_kutta
from asia.problem import ParameterRange, Physics
from asia.problem.physics import parse_expression

OF_ONE = (
    "exp", "sin", "cos", "tan", "sinh", "cosh", "tanh", "sqrt", "log", "sigmoid", "softplus", "abs",
    "sign", "arcsin", "arccos", "arctan",
)  # fmt: skip
NAMES = ("a", "b", "k", "g", "twice")


def made_of(text: str) -> Equations:
    """One equation of a state a, an input b, a parameter k, a constant g and a definition."""
    physics = Physics(
        states=("a",),
        dynamics={"a": text},
        parameters={"k": ParameterRange(0.1, 1.0)},
        constants={"g": 9.81},
        definitions={"twice": "2*a", "four": "twice*twice"},
    )
    return equations(physics, ["b"], ["a"])


def derivative(system: Equations, p: AnyArray, x: AnyArray, u: AnyArray) -> AnyArray:
    return system.rates(np, x.dtype)(p, x, u)


@pytest.mark.slow
@given(
    st.recursive(
        st.sampled_from([*NAMES, "four", "1.5", "-2", "1e-3"]),
        lambda inner: st.one_of(
            st.builds("({} {} {})".format, inner, st.sampled_from("+-*"), inner),
            st.builds("(-{})".format, inner),
            st.builds("sin({})".format, inner),
        ),
        max_leaves=12,
    )
)
def test_random_expressions_have_the_value_of_their_tree(text: str) -> None:
    values = {"a": 0.7, "b": -1.3, "k": 0.4, "g": 9.81, "twice": 1.4, "four": 1.96}
    expected = parse_expression(text, "here").evaluate(values, {"sin": np.sin})
    p, x, u = np.array([0.4]), np.array([0.7]), np.array([-1.3])
    assert derivative(made_of(text), p, x, u)[0] == pytest.approx(expected)


def test_a_batch_keeps_its_shape_and_precision() -> None:
    system = made_of("a**2 - b/k + sqrt(g)")
    rng = np.random.default_rng(0)
    for precision in (np.float32, np.float64):
        p = rng.uniform(1, 2, (1, 3, 1)).astype(precision)
        x, u = (rng.normal(size=(1, 3, 5)).astype(precision) for _ in range(2))
        found = derivative(system, p, x, u)
        assert found.shape == x.shape
        assert found.dtype == precision
        np.testing.assert_allclose(found, x**2 - u / p + 9.81**0.5, rtol=1e-5, atol=1e-5)


@given(
    text=st.sampled_from(
        [
            *(f"{name}(3*a)" for name in OF_ONE),
            "arctan2(a, b)", "min(a, b, k)", "max(a, b, k)", "clip(a, -k, b)", "a**b", "a**3 - g",
            "a/b", "exp(a**2) - exp(b**2)",
        ]
    ),
    a=st.floats(-40.0, 40.0),
    b=st.sampled_from([-1.5, 0.0, 0.5, 30.0]),
)  # fmt: skip
def test_a_single_case_has_the_value_of_a_case_in_a_batch(text: str, a: float, b: float) -> None:
    p, x, u = (np.full((1, 1, 1), value) for value in (0.4, a, b))
    system = made_of(text)
    with np.errstate(all="ignore"):
        single = derivative(system, p, x, u)
        batch = derivative(system, p, np.repeat(x, 2, axis=2), np.repeat(u, 2, axis=2))
    assert single.shape == x.shape
    np.testing.assert_allclose(single, batch[..., :1], rtol=1e-12, atol=1e-300)


def test_long_sums_and_names_that_python_keeps_for_itself() -> None:
    physics = Physics(
        states=("lambda_", "f_sin", "p"),
        dynamics={"lambda_": "+".join(["f_sin"] * 300), "f_sin": "p*sin(v_0)", "p": "1"},
    )
    system = equations(physics, ["v_0", "x"], ["p"])
    x = np.array([1.0, 2.0, 3.0])
    found = derivative(system, np.zeros(0), x, np.array([0.5, 9.0]))
    np.testing.assert_allclose(found, [600.0, 3.0 * np.sin(0.5), 1.0])


def test_division_by_zero_is_a_value_and_no_error() -> None:
    system = made_of("g/(b*0)")
    with np.errstate(divide="ignore"):
        assert np.isinf(derivative(system, np.ones(1), np.ones(1), np.ones(1))[0])


def test_names_are_read_as_they_stand() -> None:
    system = made_of("a")
    p, x, u = np.array([0.4]), np.array([0.7]), np.array([-1.3])
    np.testing.assert_allclose(system.named(NAMES, p, x, u), [0.7, -1.3, 0.4, 9.81, 1.4])
    assert system.named((), p, x[:, None] * np.ones(6), u).shape == (0, 6)


def test_equal_equations_share_their_functions() -> None:
    one, two, other = made_of("a + b"), made_of("a + b"), made_of("a - b")
    assert one.rates(np) is two.rates(np)
    assert other.rates(np) is not one.rates(np)
    assert other.rates(jax.numpy) is not other.rates(np)


def test_runge_kutta_is_of_fourth_order() -> None:
    def error(step: float) -> float:
        x = np.ones(1)
        for _ in range(round(1 / step)):
            x = runge_kutta(lambda x, u: u * x, x, -np.ones((3, 1)), step)
        return float(abs(x[0] - np.exp(-1)))

    assert error(0.1) / error(0.05) == pytest.approx(16.0, rel=0.1)
