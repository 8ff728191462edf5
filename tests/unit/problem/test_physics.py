"""The [physics] section: every mistake is named with its field."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asia.errors import UserError
from asia.models._equations.ode import equations
from asia.problem import Bounds, Correction, ParameterRange, Physics, Prior
from asia.problem.physics import check_physics, definition_order

TANKS = Physics(
    states=("x1", "x2"),
    parameters={f"k{i}": ParameterRange(1e-3, 1.0) for i in (1, 2, 3, 4)},
    constants={"g": 9.81},
    definitions={"q1": "k1*sqrt(x1)", "q2": "k3*sqrt(x2)"},
    dynamics={"x1": "-q1 + k4*pump", "x2": "k2*sqrt(x1) - q2"},
    observation={"level": "x2"},
    bounds={"x1": Bounds(min=0.0), "x2": Bounds(0.0, 10.0)},
)


def test_the_two_tanks_pass() -> None:
    check_physics(TANKS, ["pump"], ["level"])


def test_an_output_with_the_name_of_a_state_needs_no_observation() -> None:
    check_physics(replace(TANKS, observation={}), ["pump"], ["x2"])


def test_definitions_come_after_those_they_use() -> None:
    physics = replace(TANKS, definitions={"a": "b + c", "b": "c*2", "c": "x1"})
    assert definition_order(physics) == ("c", "b", "a")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"states": ()}, "states: at least one"),
        ({"states": ("x1", "x1", "x2")}, "'x1' is already a state"),
        ({"states": ("x1", "x2", "x3")}, "[physics.dynamics] x3: missing"),
        ({"constants": {"x1": 1.0}}, "[physics.constants]: 'x1' is already a state"),
        ({"constants": {"pump": 1.0}}, "'pump' is already an input"),
        ({"constants": {"sqrt": 1.0}}, "'sqrt' is already a function"),
        ({"constants": {"pi": 3.0}}, "'pi' is already a number"),
        ({"constants": {"a b": 3.0}}, "'a b' cannot be written"),
        ({"constants": {"g": float("nan")}}, "[physics.constants] g"),
        (
            {"parameters": {**TANKS.parameters, "k1": ParameterRange(1.0, 1.0)}},
            "[physics.parameters] k1: min 1.0 must be below max 1.0",
        ),
        (
            {"parameters": {**TANKS.parameters, "k1": ParameterRange(0.0, float("inf"))}},
            "[physics.parameters] k1",
        ),
        ({"bounds": {"x3": Bounds()}}, "[physics.bounds] x3: there is no such state"),
        ({"bounds": {"x1": Bounds(2.0, 1.0)}}, "[physics.bounds] x1: min 2.0"),
        (
            {"dynamics": {**TANKS.dynamics, "x22": "0"}},
            "[physics.dynamics] x22: there is no such state; did you mean 'x2'",
        ),
        (
            {"dynamics": {"x1": "-q1 + k4*pmup", "x2": "0"}},
            "[physics.dynamics] x1: undefined symbol 'pmup'; did you mean 'pump'",
        ),
        ({"dynamics": {"x1": "sqr(x1)", "x2": "0"}}, "no function 'sqr'; did you mean 'sqrt'"),
        ({"dynamics": {"x1": "sqrt", "x2": "0"}}, "'sqrt' is a function: call it"),
        ({"definitions": {"q1": "q2", "q2": "q1"}}, "q1, q2 refer to each other"),
        ({"definitions": {**TANKS.definitions, "q3": "q3 + 1"}}, "q3 refer"),
        ({"definitions": {**TANKS.definitions, "q3": "zz"}}, "[physics.definitions] q3: undef"),
        ({"observation": {"levle": "x2"}}, "levle: there is no such output; did you mean 'level'"),
        ({"observation": {}}, "[physics.observation] level: missing"),
        ({"observation": {"level": "x3"}}, "[physics.observation] level: undefined symbol 'x3'"),
    ],
)
def test_a_mistake_is_named_with_its_field(change: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        check_physics(replace(TANKS, **change), ["pump"], ["level"])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_input_that_is_no_identifier_causes_no_clash() -> None:
    physics = Physics(states=("x",), dynamics={"x": "-x"})
    check_physics(physics, ["pump voltage"], ["x"])


@pytest.mark.parametrize(
    ("priors", "words"),
    [
        ({"k1/k9": Prior(1.0, 0.1)}, "undefined symbol 'k9'"),
        ({"k1/x1": Prior(1.0, 0.1)}, "undefined symbol 'x1'"),
        ({"2 + 1": Prior(1.0, 0.1)}, "names no parameter"),
        ({"k1/k2": Prior(1.0, 0.0)}, "a deviation above 0"),
        ({"k1/k2": Prior(float("inf"), 1.0)}, "a finite mean"),
    ],
)
def test_a_prior_is_of_parameters(priors: dict[str, Prior], words: str) -> None:
    with pytest.raises(UserError, match=words):
        check_physics(replace(TANKS, priors=priors), ["pump"], ["level"])
    check_physics(replace(TANKS, priors={"k1/k2": Prior(1.0, 0.1)}), ["pump"], ["level"])


def test_a_correction_in_an_equation_is_0() -> None:
    dynamics = {**TANKS.dynamics, "x1": f"{TANKS.dynamics['x1']} + leak"}
    leaking = replace(TANKS, dynamics=dynamics, corrections={"leak": Correction(0.1)})
    check_physics(leaking, ["pump"], ["level"])
    p, x, u = np.full(len(TANKS.parameters), 0.5), np.array([2.0, 3.0]), np.array([4.0])
    plain = equations(TANKS, ["pump"], ["level"]).rates(np)(p, x, u)
    np.testing.assert_array_equal(equations(leaking, ["pump"], ["level"]).rates(np)(p, x, u), plain)
    with pytest.raises(UserError, match="no equation uses it"):
        check_physics(replace(TANKS, corrections=leaking.corrections), ["pump"], ["level"])
    wrong = replace(leaking, corrections={"leak": Correction(0.0)})
    with pytest.raises(UserError, match="a scale above 0"):
        check_physics(wrong, ["pump"], ["level"])
