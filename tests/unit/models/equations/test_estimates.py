"""Estimates of a grey-box: errors, correlations, undetermined parameters, printed equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.candidate import ParameterEstimates
from asia.data import Trajectory
from asia.models import greybox
from asia.models._equations.identified import text
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Bounds, ParameterRange, Physics
from asia.problem.physics import parse_expression
from tests.unit.models.systems.equations import context_for, held_steps, simulated

METHOD = LevenbergMarquardt(iterations=25, starts=2)
LAG = Physics(
    states=("x",),
    parameters={"a": ParameterRange(0.02, 2.0), "b": ParameterRange(-3.0, 3.0)},
    dynamics={"x": "-a*x + b*u"},
    observation={"y": "x"},
)
TRUTH = {"a": 0.3, "b": 0.7}


def record(samples: int = 300, noise: float = 0.05, seed: int = 0) -> Trajectory:
    u = held_steps(samples, seed, -1.0, 1.0)
    x = simulated(lambda x, u: np.array([-0.3 * x[0] + 0.7 * u[0]]), u, np.array([0.4]), 0.5)
    rng = np.random.default_rng([seed, 1])
    return Trajectory(u, x + rng.normal(scale=noise, size=x.shape), 0.5, "")


def estimated(
    physics: Physics, config: greybox.Config | None = None, **settings: object
) -> tuple[greybox.GreyBox, ParameterEstimates]:
    context = context_for(physics, "u", "y", 0.5)
    records = [record(seed=seed) for seed in range(2)]
    method = replace(METHOD, **settings)
    model = greybox.build(config or greybox.Config(), context)
    model = greybox.train(model, records, context, method)
    return model, model.estimates(records, context)


def test_standard_errors_are_those_of_linear_theory_under_white_noise() -> None:
    """The errors of repeated fits of other noise are as large as each fit says of its own."""
    context = context_for(LAG, "u", "y", 0.5)
    clean, values, errors = record(noise=0.0), [], []
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(scale=0.05, size=clean.y.shape)
        one = [Trajectory(clean.u, clean.y + noise, 0.5, "")]
        model = greybox.train(greybox.build(greybox.Config(), context), one, context, METHOD)
        found = model.estimates(one, context)
        values.append([p.value for p in found.parameters])
        errors.append([p.standard_error for p in found.parameters])
    ratio = np.std(values, axis=0, ddof=1) / np.mean(errors, axis=0)
    assert np.all((ratio > 0.55) & (ratio < 1.6))


def test_intervals_lie_around_values_and_hold_the_truth() -> None:
    model, found = estimated(LAG)
    assert {p.name: p.value for p in found.parameters} == model.parameters()
    for one in found.parameters:
        assert one.low < one.value < one.high
        assert one.value - 4 * one.standard_error < TRUTH[one.name]
        assert TRUTH[one.name] < one.value + 4 * one.standard_error
        assert one.data_share == pytest.approx(1.0)
    np.testing.assert_allclose(np.diagonal(found.correlation), 1.0)
    np.testing.assert_allclose(found.correlation, found.correlation.T)
    assert found.parameters[0].lower == 0.02
    assert found.parameters[0].upper == 2.0


def test_a_product_that_alone_matters_is_not_identifiable() -> None:
    """Neither b nor c has an error where only b c acts; a has one."""
    product = replace(
        LAG,
        parameters={**LAG.parameters, "c": ParameterRange(0.1, 3.0)},
        observation={"y": "c*x"},
    )
    _, found = estimated(product)
    known = {p.name: bool(np.isfinite(p.standard_error)) for p in found.parameters}
    assert known == {"a": True, "b": False, "c": False}
    names = [p.name for p in found.parameters]
    assert np.isnan(found.correlation[names.index("b")]).all()


def test_what_a_prior_says_is_not_counted_as_the_records() -> None:
    product = replace(
        LAG,
        parameters={**LAG.parameters, "c": ParameterRange(0.1, 3.0)},
        observation={"y": "c*x"},
    )
    config = greybox.Config(priors=(("c", 1.0, 0.1, "a data sheet"),))
    _, found = estimated(product, config)
    shares = {p.name: p.data_share for p in found.parameters}
    assert shares["c"] < 0.05
    assert shares["a"] > 0.95
    errors = {p.name: p.standard_error for p in found.parameters}
    assert errors["c"] == pytest.approx(0.1, rel=0.05)  # that of the data sheet, and no better
    assert all(np.isfinite(p.standard_error) for p in found.parameters)


def test_under_a_noise_model_innovations_are_weighed() -> None:
    _, found = estimated(LAG, noise_model="slow")
    _, plain = estimated(LAG)
    for one, other in zip(found.parameters, plain.parameters, strict=True):
        assert abs(one.value - TRUTH[one.name]) < 4 * one.standard_error
        assert one.standard_error == pytest.approx(other.standard_error, rel=0.3)


def test_equations_hold_the_numbers_and_what_is_added() -> None:
    bounded = replace(LAG, bounds={"x": Bounds(min=-5.0)})
    model, found = estimated(bounded, greybox.Config(saturation=("x",), offset=("x",)))
    numbers = model.parameters()
    first, second, third = found.equations
    assert first.startswith(f"d(x)/dt = -{numbers['a']:.5g} * x + {numbers['b']:.5g} * u")
    assert second == "y = x"
    assert third == f"-5 <= x <= {numbers['x limit']:.5g}"


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("a*(x - b)", "2 * (x + 3)"),
        ("x - (b - y)", "x - (-3 - y)"),
        ("-x**2", "-x**2"),
        ("(-x)**2", "(-x)**2"),
        ("x/(a*y)", "x / (2 * y)"),
        ("b**2 + sqrt(b*x)", "(-3)**2 + sqrt(-3 * x)"),
        ("x + b*y", "x - 3 * y"),
    ],
)
def test_expressions_keep_their_meaning_in_print(expression: str, expected: str) -> None:
    node = parse_expression(expression, "test").root
    shown = text(node, {"a": 2.0, "b": -3.0})
    assert shown == expected
    place = {"a": 2.0, "b": -3.0, "x": 1.3, "y": 0.4}
    assert evaluated(shown, place) == pytest.approx(evaluated(expression, place), nan_ok=True)


def evaluated(expression: str, values: dict[str, float]) -> float:
    with np.errstate(invalid="ignore"):
        return float(parse_expression(expression, "test").evaluate(values, {"sqrt": np.sqrt}))


def test_an_unmeasured_sample_leaves_the_errors_as_they_are() -> None:
    context = context_for(LAG, "u", "y", 0.5)
    whole = record()
    found: list[ParameterEstimates] = []
    for missing in ([], [123], list(range(120, 150))):
        y = whole.y.copy()
        y[missing] = np.nan
        data = [Trajectory(whole.u, y, 0.5, ""), record(seed=1)]
        model = greybox.train(greybox.build(greybox.Config(), context), data, context, METHOD)
        found.append(model.estimates(data, context))
    for estimates in found[1:]:
        assert estimates.equations
        for one, other in zip(estimates.parameters, found[0].parameters, strict=True):
            assert one.standard_error == pytest.approx(other.standard_error, rel=0.15)
