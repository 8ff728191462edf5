"""Signed residuals name the place of a defect that was planted, and stay silent without one."""

import numpy as np
import pytest

from asia.data import Array, Signal
from asia.judge.scoring.residuals import (
    Evidence,
    PartKind,
    SignedResidual,
    evidence_of_mean,
    ranges_of,
    signed_residuals,
)

INPUTS = (Signal("valve", "V"),)
OUTPUTS = (Signal("level", "cm"),)


def slow(seed: int, length: int = 4000, pole: float = 0.9) -> Array:
    """A first-order process of variance 1."""
    white = np.random.default_rng(seed).normal(size=length) * np.sqrt(1 - pole**2)
    x = np.zeros(length)
    for k in range(1, length):
        x[k] = pole * x[k - 1] + white[k]
    return x[:, None]


def notable(u: Array, y: Array, y_hat: Array) -> list[SignedResidual]:
    return [one for one in signed_residuals([u], [y], [y_hat], y.std(axis=0)) if one.notable]


def noise(seed: int, length: int = 4000) -> Array:
    return 0.05 * np.random.default_rng(seed).normal(size=(length, 1))


def test_a_planted_bend_is_the_first_thing_said() -> None:
    truth = slow(0)
    bent = np.minimum(truth, 1.2)
    found = notable(slow(1), bent + noise(2), truth)
    assert found[0].kind is PartKind.OUTPUT
    assert found[0].high is None
    assert found[0].mean < 0
    assert found[0].words(INPUTS, OUTPUTS).startswith("level above 0.56 cm: the model is too high")


def test_a_planted_lag_is_seen_while_the_output_moves() -> None:
    truth = slow(0, pole=0.98)
    found = notable(slow(1), np.roll(truth, 2, axis=0) + 0.2 * noise(2), truth)
    signs = {one.part: one.mean for one in found if one.kind is PartKind.CHANGE}
    assert signs[0] > 0 > signs[1]
    assert "while level rises fast: the model is too high" in found[0].words(INPUTS, OUTPUTS) or (
        "while level falls fast: the model is too low" in found[0].words(INPUTS, OUTPUTS)
    )


def test_an_input_beyond_which_the_gain_changes_is_named() -> None:
    u, truth = slow(3), slow(4)
    found = notable(u, truth + 0.3 * np.maximum(u - 1.0, 0.0) + noise(5), truth)
    assert (found[0].kind, found[0].part) == (PartKind.INPUT, 4)
    assert found[0].words(INPUTS, OUTPUTS).startswith("valve above ")
    assert "level is too low by" in found[0].words(INPUTS, OUTPUTS)


def test_a_drift_is_named_along_time() -> None:
    truth = slow(6)
    drift = np.linspace(-0.3, 0.3, len(truth))[:, None]
    found = notable(slow(7), truth + drift + noise(8), truth)
    assert {(one.kind, one.part, one.mean > 0) for one in found} >= {
        (PartKind.TIME, 0, False), (PartKind.TIME, 2, True),
    }  # fmt: skip


def test_a_model_that_is_slow_after_steps_is_named() -> None:
    u = np.repeat(np.tile([0.0, 1.0], 20), 100)[:, None]
    truth = slow(9) + u
    late = np.zeros_like(truth)
    for k in range(100, len(u), 100):
        late[k : k + 20, 0] = 0.5 * (u[k, 0] - u[k - 1, 0])
    found = notable(u, truth + late + noise(10), truth)
    steps = {one.part: one.mean for one in found if one.kind is PartKind.STEP}
    assert steps[0] < 0 < steps[1]


@pytest.mark.parametrize("pole", [0.0, 0.9, 0.97])
def test_noise_says_nothing_even_where_it_is_coloured(pole: float) -> None:
    said = 0
    for seed in range(20):
        truth = slow(2 * seed + 100)
        said += len(notable(slow(seed), truth + 0.2 * slow(2 * seed + 101, pole=pole), truth))
    assert said <= 3


def test_records_do_not_run_into_each_other() -> None:
    u = [np.zeros((100, 1)), np.ones((100, 1))]
    y = [slow(0, 100), slow(1, 100)]
    steps = [
        one for one in signed_residuals(u, y, [a + 1.0 for a in y], np.ones(1))
        if one.kind is PartKind.STEP
    ]  # fmt: skip
    assert steps == []


def test_a_perfect_model_and_an_output_at_rest_have_nothing_to_say() -> None:
    y = slow(0)
    assert notable(slow(1), y, y) == []
    still = np.ones((500, 1))
    assert signed_residuals([slow(1, 500)], [still], [still], np.ones(1)) == ()


def test_folds_share_the_parts_of_the_ranges_they_are_given() -> None:
    u, y = slow(0), slow(1)
    ranges = ranges_of([u], [y])
    half = slice(0, 2000)
    found = signed_residuals([u[half]], [y[half]], [y[half] + 0.1], np.ones(1), ranges)
    edges = {one.high for one in found if one.kind is PartKind.INPUT and one.high is not None}
    assert edges == set(ranges.inputs[0])


def test_a_wrong_initial_state_is_said_of_the_start_and_of_no_range() -> None:
    """The input is high at the beginning alone, where the initial state is wrong."""
    truth, u = slow(0, 1000), np.zeros((1000, 1))
    u[:50] = np.random.default_rng(1).uniform(5.0, 6.0, (50, 1))
    wrong = np.zeros_like(truth)
    wrong[:50] = 2.0
    found = signed_residuals([u], [truth + wrong + noise(2, 1000)], [truth], truth.std(axis=0))
    start = next(one for one in found if one.kind is PartKind.START)
    assert start.mean > 1.5
    assert start.words(INPUTS, OUTPUTS).startswith(
        "start, the first 5 % of a simulation: the simulated level is"
    )
    assert all(abs(one.mean) < 0.2 for one in found if one.kind is PartKind.INPUT)


def test_the_mean_over_all_samples_is_one_of_the_parts() -> None:
    truth = slow(0)
    (whole,) = (
        one
        for one in signed_residuals([slow(1)], [truth - 0.5 + noise(2)], [truth], np.ones(1))
        if one.kind is PartKind.ALL
    )
    assert whole.mean == pytest.approx(-0.5, abs=0.01)
    assert whole.words(INPUTS, OUTPUTS).startswith(
        "mean over all samples: the simulated level is too high by 0.5"
    )


@pytest.mark.parametrize(
    ("mean", "said"), [(0.2, Evidence.CLEAR), (0.14, Evidence.CHANCE), (0.09, Evidence.NONE)]
)
def test_one_rule_decides_significance(mean: float, said: Evidence) -> None:
    one = SignedResidual(
        0, PartKind.ALL, 0, 0, None, None, -mean, 0.1, 100, 0.2, 0.2, notable=False
    )
    assert one.evidence is said
    assert ("standard errors: may be chance)" in one.size) is (said is Evidence.CHANCE)


def test_a_large_mean_in_standard_errors_is_nothing_where_it_is_a_small_share() -> None:
    assert evidence_of_mean(1.0, 0.1, 0.01) is Evidence.NONE
