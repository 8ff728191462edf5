"""The next experiment: gains in closed form, limits, and models that differ in one place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from asia.control.experiment_design import (
    InputLimits,
    Judge,
    Subject,
    aprbs,
    design_experiment,
    multisine,
)
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.problem.identifiability import ParameterChanges
from asia.problem.physics import ParameterRange, Physics

LIMITS = InputLimits(np.zeros(1), np.full(1, 10.0), np.full(1, np.inf), np.full(1, 2.0))
FREE = np.array([[-np.inf], [np.inf]])


def lag(static: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """A static function of the input behind a lag, at rest before, (B, H, 1)."""

    def simulate(u: Array) -> Array:
        x, y = static(np.full((len(u), 1), 2.0)), np.empty_like(u)
        for k in range(u.shape[1]):
            y[:, k] = x
            x = 0.8 * x + 0.2 * static(u[:, k])
        return y

    return simulate


def bent(knee: float) -> Callable[[Array], Array]:
    return lag(lambda v: np.minimum(v, knee) + 0.2 * np.maximum(v - knee, 0.0))


def subject(*models: Callable[[Array], Array], keep: Array = FREE) -> Subject:
    return Subject(
        lambda u: np.stack([model(u) for model in models]),
        tuple(range(len(models))),
        dict.fromkeys(range(len(models)), 1.0),
        np.full(1, 0.1),
        LIMITS,
        keep,
        lambda u, y: np.full_like(y, 0.05),
    )


def test_the_record_visits_the_place_where_the_models_differ() -> None:
    # They are alike below 8.
    found = design_experiment(subject(bent(8.0), bent(20.0)), 60, generations=6)
    above = [float((one.u > 8.0).mean()) for one in (found.proposed, found.multisine)]
    assert above[0] > above[1]
    assert found.proposed.left < found.before
    assert found.proposed.left <= min(found.aprbs.left, found.multisine.left)
    assert found.proposed.gain >= max(found.aprbs.gain, found.multisine.gain)


def test_rivals_have_the_energy_of_the_proposed_record() -> None:
    found = design_experiment(subject(bent(8.0), bent(20.0)), 60, generations=2)
    energies = [LIMITS.energy(one.u[None])[0] for one in (found.aprbs, found.multisine)]
    assert energies == pytest.approx([found.energy] * 2, rel=0.03)
    assert found.energy <= 1.0 / 3.0 + 1e-9


def test_input_limits_and_rate_hold() -> None:
    slow = replace(LIMITS, step=np.full(1, 0.5))
    of = replace(subject(bent(8.0), bent(20.0)), limits=slow)
    found = design_experiment(of, 60, generations=2)
    for one in (found.proposed, found.aprbs, found.multisine):
        assert one.u.min() >= 0.0
        assert one.u.max() <= 10.0
        assert np.abs(np.diff(one.u, axis=0, prepend=slow.rest[None])).max() <= 0.5 + 1e-9


def test_expected_outputs_stay_inside_their_limits() -> None:
    keep = np.array([[1.0], [6.0]])
    found = design_experiment(subject(bent(8.0), bent(20.0), keep=keep), 60, generations=4)
    assert found.proposed.excess == 0.0
    assert found.proposed.upper.max() <= 6.0
    assert found.proposed.lower.min() >= 1.0
    assert found.aprbs.upper.max() > 6.0
    assert found.aprbs.excess > 0.0


def test_a_limit_that_the_resting_output_breaks_is_reported() -> None:
    keep = np.array([[-np.inf], [1.0]])
    found = design_experiment(subject(bent(8.0), bent(20.0), keep=keep), 60, generations=2)
    assert found.proposed.excess > 0.0
    assert not found.proposed.rank[0]


def unstable(u: Array) -> Array:
    with np.errstate(all="ignore"):
        return np.exp(np.cumsum(np.abs(u), axis=1))


def test_a_model_that_diverges_is_left_out() -> None:
    found = design_experiment(subject(bent(8.0), bent(20.0), unstable), 60, generations=2)
    assert found.members == (0, 1)
    assert found.proposed.y.shape[0] == 2


def test_models_that_all_diverge_are_an_error() -> None:
    with pytest.raises(UserError, match="give narrower --limits"):
        design_experiment(subject(lambda u: np.full_like(u, np.nan)), 60, generations=1)


def test_the_error_that_a_parameter_leaves_has_its_closed_form() -> None:
    # y = theta * u with theta known to 0.5: a record leaves 1 / (1 / 0.5^2 + sum u^2 / noise^2).
    def line(u: Array) -> Array:
        return 3.0 * u

    of = replace(
        subject(line), changes=lambda u: 0.5 * u[None], reach=lambda u, y: np.zeros_like(y)
    )
    judge = Judge(of, 40, 4.0)
    u = aprbs(np.random.default_rng(3), 40, LIMITS, 1.0, 5.0)
    (judged,) = judge(u[None])
    share = 1.0 / np.sqrt(1.0 + 0.25 * float((u**2).sum()) / 0.01)
    assert judged.left == pytest.approx(judge.before * share, rel=1e-6)


def test_a_difference_seen_in_one_place_says_little_about_another_place() -> None:
    judge = Judge(subject(bent(8.0), bent(20.0)), 100, 5.0)
    low, high = judge(np.stack([np.full((100, 1), 2.0), np.full((100, 1), 10.0)]))
    assert low.left == pytest.approx(judge.before, rel=0.02)
    assert high.left < 0.8 * judge.before


def test_a_multisine_is_as_large_as_its_limits_allow() -> None:
    u = multisine(np.random.default_rng(0), 200, LIMITS, 8.0)
    assert np.abs(u - 5.0).max() == pytest.approx(5.0)
    power = np.abs(np.fft.rfft(u[:, 0] - u.mean()))
    assert power[26:].max() < 1e-9 * power[1:26].max()


TANK = Physics(
    states=("x",),
    parameters={"a": ParameterRange(1e-3, 1.0), "b": ParameterRange(1e-3, 1.0)},
    dynamics={"x": "-a*sqrt(x) + b*u"},
    observation={"y": "2*x"},
)


def test_changes_by_parameters_are_those_of_the_equations() -> None:
    values, u = {"a": 0.3, "b": 0.2}, np.full((3, 30, 1), 2.0)
    u[0, 10:] = 1.0
    u[1, 5:20] = 3.0
    u[2, 5:] = 0.0  # It runs empty, where the derivative of the root has no bound.
    rest = np.full(1, 2.0), np.full(1, 2.0 * (0.2 * 2.0 / 0.3) ** 2)
    directions = np.array([[0.02, 0.0], [0.01, -0.03]])
    found = ParameterChanges(TANK, (["u"], ["y"]), values, directions, rest, 1.0)(u)

    def simulated(a: float, b: float, case: int) -> Array:
        """Euler's method with steps far below a sample."""
        x, y = (b * 2.0 / a) ** 2, []
        for (now,) in u[case]:
            y.append(2.0 * x)
            for _ in range(400):
                x += (-a * np.sqrt(max(x, 0.0)) + b * now) / 400
        return np.array(y)

    for q, (da, db) in enumerate(directions):
        for case in range(3):
            ends = [simulated(0.3 + s * da, 0.2 + s * db, case) for s in (1.0, -1.0)]
            numeric = (ends[0] - ends[1]) / 2.0
            assert found[q, case, :, 0] == pytest.approx(numeric, abs=5e-3 * np.abs(numeric).max())
