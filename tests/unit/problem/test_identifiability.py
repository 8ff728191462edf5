"""Structural identifiability: known symmetries of equations are found, and nothing else."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.data import Trajectory
from asia.problem import Physics, Prior
from asia.problem.identifiability import unidentifiable
from asia.problem.physics import Correction, ParameterRange, check_physics

RANDOM = np.random.default_rng(0)
RECORDS = [Trajectory(RANDOM.random((200, 1)), RANDOM.random((200, 1)), 0.1, "r")]


def equations(
    dynamics: Mapping[str, str], output: str, parameters: str, priors: Sequence[str] = ()
) -> Physics:
    ranges = {
        name: ParameterRange(-5.0, 5.0) if name == "shift" else ParameterRange(0.1, 10.0)
        for name in parameters.split()
    }
    physics = Physics(
        tuple(dynamics), dynamics, ranges, observation={"y": output},
        priors={text: Prior(1.0, 0.1) for text in priors},
    )  # fmt: skip
    check_physics(physics, ["u"], ["y"])
    return physics


SPRING = {"x": "v", "v": "(g*u - c*v - k*x)/m"}


@pytest.mark.parametrize(
    ("dynamics", "output", "parameters", "expected"),
    [
        ({"x": "-x + a*b*u"}, "x", "a b", ["a, b one by one, only a*b:"]),
        ({"x": "-c*x + a/b*u"}, "x", "a b c", ["a, b one by one, only a/b:"]),
        ({"x": "-a*x + u + 0*c"}, "x", "a c", ["c: it does not act on any output"]),
        ({"x": "-(3 + 0.1*a + 0.1*b)*x + u"}, "x", "a b", ["a, b one by one, only a + b:"]),
        ({"x": "-x + u + a"}, "x + shift", "a shift", ["a, shift one by one, only a + shift:"]),
        (SPRING, "x", "m c k g", ["m, c, k, g one by one, only m/g and c/g and k/g:"]),
        ({"x": "-a*b*x + c*d*u"}, "x", "a b c d", ["a, b one by one, only a*b:",
                                                   "c, d one by one, only c*d:"]),
        ({"s": "-a*s/(b + s) + u", "e": "-d*e + s"}, "s", "a b d", ["d: it does not act"]),
        ({"x": "-a*x + u", "z": "-b*z + x"}, "z", "a b", []),
        (SPRING | {"v": "(u - c*v - k*x)/m"}, "x", "m c k", []),
    ],
)  # fmt: skip
def test_a_symmetry_of_the_parameters_is_named(
    dynamics: Mapping[str, str], output: str, parameters: str, expected: list[str]
) -> None:
    found = unidentifiable(equations(dynamics, output, parameters), ["u"], ["y"], RECORDS)
    assert found is not None
    assert len(found) == len(expected)
    for one, text in zip(found, expected, strict=True):
        assert f"no record can determine {text}" in str(one)


def test_a_prior_decides_only_where_it_changes_along_the_symmetry() -> None:
    for priors, decided in ((["a"], True), (["a*b"], False), (["a*b", "a/b"], True)):
        physics = equations({"x": "-x + a*b*u"}, "x", "a b", priors)
        found = unidentifiable(physics, ["u"], ["y"], RECORDS)
        assert found is not None
        assert found[0].has_priors is decided
        assert ("[physics.priors] decides the rest" in str(found[0])) is decided


def test_equations_that_cannot_be_simulated_are_not_judged() -> None:
    physics = equations({"x": "a*exp(exp(exp(9 + x**2)))"}, "x", "a")
    assert unidentifiable(physics, ["u"], ["y"], RECORDS) is None


@pytest.mark.long
def test_the_drone_with_fifteen_parameters_is_identifiable_from_its_pose_and_rates() -> None:
    file = Path(asia.__file__).parent / "problems" / "nanodrone" / "problem.toml"
    table = tomllib.loads(file.read_text("utf-8"))
    known = table["physics"]
    inputs = ["m1_rads", "m2_rads", "m3_rads", "m4_rads"]
    physics = Physics(
        tuple(known["states"]), known["dynamics"],
        {name: ParameterRange(**span) for name, span in known["parameters"].items()},
        known["constants"], known["definitions"],
        corrections={name: Correction(**one) for name, one in known["corrections"].items()},
    )  # fmt: skip
    check_physics(physics, inputs, physics.states)
    rng = np.random.default_rng(1)
    records = [
        Trajectory(rng.uniform(1500, 2500, (50, 4)), rng.uniform(-0.3, 0.3, (50, 12)), 0.01, "r")
    ]
    assert unidentifiable(physics, inputs, physics.states, records) == []
    lost = [name for name in physics.states if name not in ("wx", "wy", "wz", "yaw")]
    assert unidentifiable(physics, inputs, lost, records) == []
