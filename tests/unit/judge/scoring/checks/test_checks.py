"""Each check passes a sound model and flags the defect it is there for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.signal import lfilter

from asia.data import Array
from asia.data.segment import Segment, SimulatedSegment
from asia.judge.scoring.bands import region_of
from asia.judge.scoring.checks.check import Cause, Check, Verdict, most_serious
from asia.judge.scoring.checks.errors import (
    check_bands,
    check_overfit,
    check_region,
    check_steps_ahead,
    no_bands,
)
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import (
    HORIZONS,
    check_frequency_response,
    check_gain,
    check_long_run,
    check_responses,
    check_spectrum,
    frequency_response_of,
    impulse_response,
)
from asia.judge.scoring.checks.validation_data import (
    LinearResponse,
    SimulatedSegments,
    ValidationData,
    without_responses,
)
from asia.judge.scoring.residuals import cross_correlation

B, A = [0.0, 0.2, 0.1], [1.0, -1.3, 0.5]
SAMPLES = 1200


def segment(u: Array, y: Array, y_hat: Array, start: int) -> SimulatedSegment:
    return Segment(u[:0], y[:0], u, y, start=start).simulated(y_hat)


def simulations(y_hat: Array, y: Array, u: Array) -> SimulatedSegments:
    cut = zip(np.array_split(u, 3), np.array_split(y, 3), np.array_split(y_hat, 3), strict=True)
    blocks = tuple(
        segment(a[:, None], b[:, None], c[:, None], 400 * k) for k, (a, b, c) in enumerate(cut)
    )
    return SimulatedSegments(blocks, ("valve",), ("level",), 0.5)


def data_with(**fields: Any) -> ValidationData:
    """Data of a model with outputs between -1 and 1, with other responses."""
    zeros = np.zeros(SAMPLES)
    data = without_responses(simulations(zeros, zeros, zeros))
    return replace(data, lowest=np.array([-1.0]), highest=np.array([1.0]), **fields)


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(3)


def held_steps(random: np.random.Generator) -> Array:
    return np.repeat(random.uniform(-1, 1, SAMPLES // 8), 8) + 0.2 * random.standard_normal(SAMPLES)


def flagged(checks: tuple[Check, ...]) -> set[Cause | None]:
    return {c.cause for c in checks if c.verdict in (Verdict.DOUBT, Verdict.FAIL)}


def all_checks(found: SimulatedSegments) -> tuple[Check, ...]:
    data = without_responses(found)
    return (*residual_checks(data), check_gain(data), check_frequency_response(data))


def test_a_sound_model_under_coloured_noise_passes(random: np.random.Generator) -> None:
    u = held_steps(random)
    y_hat = signal.lfilter(B, A, u)
    noise = signal.lfilter([0.05], [1.0, -0.95], random.standard_normal(SAMPLES))
    checks = all_checks(simulations(y_hat, y_hat + noise, u))
    assert flagged(checks) == set()
    assert [one.verdict for one in checks].count(Verdict.PASS) == 7


@pytest.mark.parametrize(
    ("defect", "cause"),
    [
        (lambda y, t: np.concatenate([np.zeros(4), y[:-4]]), Cause.DYNAMICS),
        (lambda y, t: signal.lfilter([0.3], [1.0, -0.7], y), Cause.DYNAMICS),
        (lambda y, t: np.minimum(y, 0.3), Cause.STATIC),
        (lambda y, t: y + 1e-3 * t, Cause.DRIFT),
        (lambda y, t: y - 0.3 * np.sign(np.gradient(y)), Cause.FRICTION),
        (lambda y, t: -y, Cause.SIGN),
    ],
    ids=["delay", "lag", "saturation", "drift", "friction", "sign"],
)
def test_the_missing_dynamics_are_named_first(defect, cause, random) -> None:
    u = held_steps(random)
    y_hat = signal.lfilter(B, A, u)
    y = defect(y_hat, np.arange(SAMPLES)) + 0.02 * random.standard_normal(SAMPLES)
    checks = all_checks(simulations(y_hat, y, u))
    worst = most_serious(checks)
    assert worst is not None
    assert worst.cause is cause, worst.sentence


def test_the_sentence_names_input_output_and_lags(random: np.random.Generator) -> None:
    u = random.standard_normal(SAMPLES)
    y_hat = np.zeros(SAMPLES)
    y = np.concatenate([np.zeros(5), u[:-5]]) + 0.1 * random.standard_normal(SAMPLES)
    check = residual_checks(without_responses(simulations(y_hat, y, u)))[1]
    assert check.verdict is Verdict.FAIL
    assert "the residual of level follows valve at lag 5" in check.sentence


def test_a_negligible_effect_passes(random: np.random.Generator) -> None:
    u = held_steps(random)
    y_hat = signal.lfilter(B, A, u)
    late = np.concatenate([np.zeros(1), u[:-1]])
    assert flagged(all_checks(simulations(y_hat, y_hat + 1e-3 * late, u))) == set()


def test_correlations_are_those_of_scipy(random: np.random.Generator) -> None:
    e, u = random.standard_normal((2, 300))
    e, u = e - e.mean(), u - u.mean()
    wanted = signal.correlate(e, u, "full")[299 - 25 : 299 + 26]
    wanted /= np.sqrt(np.sum(e**2) * np.sum(u**2))
    np.testing.assert_allclose(cross_correlation([e], [u], 25), wanted, rtol=0, atol=1e-10)


def test_the_linearised_frequency_response_is_that_of_the_linear_system() -> None:
    size, omega = 1e-3, np.linspace(0.01, 3.0, 50)
    base = np.full(900, 0.7)
    settled = 400
    up, down = base.copy(), base.copy()
    up[settled:] += size
    down[settled:] -= size
    answers = [signal.lfilter(B, A, x)[settled:, None] for x in (up, down)]
    impulse = impulse_response(*answers, size)
    wanted = signal.freqz(B, A, omega)[1]
    np.testing.assert_allclose(frequency_response_of(impulse, omega)[:, 0], wanted, atol=1e-8)
    one = LinearResponse("middle inputs", "valve", impulse)
    assert one.settled
    assert one.step[-1, 0] == pytest.approx(sum(B) / sum(A), abs=1e-9)
    check = check_responses(data_with(linear_responses=(one,)))
    assert check.verdict is Verdict.SHOWN
    assert "static gain 1.5 on level" in check.sentence


def test_the_same_response_by_python_control() -> None:
    import control

    omega = np.linspace(0.01, 3.0, 50)
    impulse = signal.lfilter(B, A, np.eye(1, 600)[0])[:, None]
    system = control.tf(B, A, True)
    wanted = np.array([system(np.exp(1j * w)) for w in omega])
    np.testing.assert_allclose(frequency_response_of(impulse, omega)[:, 0], wanted, atol=1e-8)


@pytest.mark.parametrize(
    ("poles", "verdict"), [((0.98, 0.95, 0.95), Verdict.PASS), ((0.3, 0.2), Verdict.FAIL)]
)
def test_the_gain_is_judged_where_the_output_has_power(poles, verdict, random) -> None:
    """A moving average of two samples has no gain at the Nyquist frequency."""
    u = random.standard_normal(SAMPLES)
    a = np.poly(poles)
    y = signal.lfilter([0.0, a.sum()], a, u)
    found = simulations(signal.lfilter([0.5, 0.5], [1.0], y), y, u)
    check = check_frequency_response(without_responses(found))
    assert check.verdict is verdict
    assert check.sentence.startswith("where it costs most, ") is (verdict is Verdict.PASS)
    assert ("a mode, a delay or a gain" in check.sentence) is (verdict is Verdict.FAIL)


def test_a_smooth_function_of_the_rate_is_not_called_friction(random: np.random.Generator) -> None:
    u = signal.lfilter([0.1], [1.0, -0.9], random.standard_normal(SAMPLES))
    y_hat = signal.lfilter(B, A, u)
    rate = np.gradient(y_hat)
    rate /= rate.std()
    for effect, expected in ((rate * np.abs(rate), set()), (np.sign(rate), {Cause.FRICTION})):
        noise = 0.02 * y_hat.std() * random.standard_normal(SAMPLES)
        y = y_hat + 0.03 * y_hat.std() * effect + noise
        motion = [c for c in residual_checks(without_responses(simulations(y_hat, y, u)))
                  if c.name == "motion"]  # fmt: skip
        assert flagged(tuple(motion)) == expected


@pytest.mark.parametrize(
    ("moves", "factor", "verdict"),
    [(1.0, 1.0, Verdict.PASS), (1.0, -1.0, Verdict.FAIL), (0.0, 1.0, Verdict.SHOWN)],
)
def test_the_sign_of_a_gain_is_judged_where_the_records_have_it(
    moves: float, factor: float, verdict: Verdict, random: np.random.Generator
) -> None:
    """With `moves` of 0 the output is noise beside the input."""
    u = held_steps(random)
    effect = signal.lfilter(B, A, u)
    y = moves * effect + 0.1 * effect.std() * random.standard_normal(SAMPLES)
    found = check_gain(without_responses(simulations(factor * effect, y, u)))
    assert found.verdict is verdict
    assert ("not tested" in found.sentence) is (verdict is Verdict.SHOWN)


def test_a_long_run() -> None:
    t = np.arange(HORIZONS * 100.0)
    wave = np.sin(t)[:, None]
    assert check_long_run(data_with(long_run=lambda: wave)).verdict is Verdict.PASS
    rising = wave + 1e-3 * 1.01 ** t[:, None]
    assert check_long_run(data_with(long_run=lambda: rising)).cause is Cause.UNSTABLE
    ramp = check_long_run(data_with(long_run=lambda: wave + 0.02 * t[:, None]))
    assert (ramp.verdict, ramp.cause) == (Verdict.DOUBT, None)
    assert check_long_run(data_with(long_run=lambda: None)).verdict is Verdict.FAIL


def test_errors_that_grow_where_the_model_was_not_fitted() -> None:
    many, few = _white_errors(400), _white_errors(6)
    assert check_overfit([0.1, 0.1], [0.12, 0.11], many).verdict is Verdict.PASS
    assert check_overfit([0.1, 0.1], [0.1, 0.5], many).verdict is Verdict.PASS
    assert check_overfit([0.1, 0.1], [0.2, 0.18], many).verdict is Verdict.DOUBT
    assert check_overfit([0.1, 0.1], [0.3, 0.4], many).verdict is Verdict.FAIL
    # The same ratio is chance where few errors are independent.
    chance = check_overfit([0.1, 0.1], [0.2, 0.18], few)
    assert chance.verdict is Verdict.PASS
    assert "which is chance" in chance.sentence


def test_a_model_of_few_parameters_does_not_fit_the_noise_of_many_samples() -> None:
    ratio = [0.1, 0.1], [0.2, 0.2]
    few = check_overfit(*ratio, _white_errors(5_000), parameters=12)
    assert (few.verdict, few.cause) == (Verdict.DOUBT, None)
    assert "12 fitted numbers explain a ratio of 1.0" in few.sentence
    many = check_overfit(*ratio, _white_errors(5_000), parameters=3_000)
    assert many.cause is Cause.OVERFIT
    assert check_overfit(*ratio, _white_errors(5_000)).cause is None


def _white_errors(samples: int) -> SimulatedSegments:
    """Two blocks whose errors are independent."""
    rng = np.random.default_rng(0)
    y_hat = np.sin(0.1 * np.arange(samples))[:, None]
    noise = 0.1 * rng.standard_normal((2, samples, 1))
    blocks = [segment(y_hat, y_hat + e, y_hat, k * samples) for k, e in enumerate(noise)]
    return SimulatedSegments(tuple(blocks), ("u",), ("y",), 1.0)


def test_a_record_outside_the_region(random: np.random.Generator) -> None:
    u = held_steps(random)
    y = signal.lfilter(B, A, u)
    region = region_of([(u[:, None], y[:, None])])
    assert check_region(simulations(y, y, u), region).verdict is Verdict.PASS
    far = check_region(simulations(6 * y, y, 6 * u), region)
    assert far.verdict is Verdict.FAIL
    assert "outside the region of validity, first at " in far.sentence


def test_steps_ahead_against_the_last_output() -> None:
    small, large = np.full((5, 20, 1), 0.1), np.full((5, 20, 1), 0.4)
    assert check_steps_ahead(small, large, np.ones(1)).verdict is Verdict.PASS
    assert check_steps_ahead(large, small, np.ones(1)).verdict is Verdict.DOUBT


def test_the_error_spectrum_is_shown_with_the_noise(random: np.random.Generator) -> None:
    u = held_steps(random)
    y = signal.lfilter(B, A, u)
    found = simulations(y, y + 0.1 * y.std() * random.standard_normal(SAMPLES), u)
    check = check_spectrum(replace(without_responses(found), noise=lambda: [0.1]))
    assert check.verdict is Verdict.SHOWN
    assert "noise 10 %" in check.sentence
    assert len(check.curves) == 2


def test_bands_that_hold_too_little() -> None:
    names = ("a", "b", "c", "d")
    many, none = np.full(4, 100.0), ("",) * 4
    good = check_bands(np.array([0.91, 0.84, 0.9, 1.0]), many, names, 0.9, none)
    assert good.verdict is Verdict.PASS
    assert good.sentence == "90 % output bands contained at least: b 84 %, c 90 %, a 91 %"
    for held, errors, verdict in ((0.79, 100, Verdict.FAIL), (0.79, 10, Verdict.PASS)):
        one = check_bands(np.array([held]), np.array([errors]), ("a",), 0.9, ("",))
        assert one.verdict is verdict
    found = check_bands(np.array([0.9]), np.array([100]), ("a",), 0.9, ("the reason",))
    assert found.verdict is Verdict.FAIL
    assert found.sentence == "the output bands of a are withdrawn: the reason"
    assert no_bands("why").verdict is Verdict.ABSENT


def test_the_gain_of_the_data_is_drawn_where_it_is_clear(random: np.random.Generator) -> None:
    u = held_steps(random)
    y_hat = signal.lfilter(B, A, u)
    slow = signal.lfilter([0.02], [1.0, -0.98], u)
    noisy = slow + 0.05 * random.standard_normal(SAMPLES)
    check = check_frequency_response(without_responses(simulations(slow, noisy, u)))
    assert check.curves[0].name == "valve to level, data, coherence above 0.5"
    assert "agrees with the data within statistical error" in check.sentence
    clear = check_frequency_response(without_responses(simulations(y_hat, y_hat, u)))
    assert 0 < len(check.curves[0].x) < len(clear.curves[0].x)


def _gain_changes(sizes: tuple[float, float], noise: float = 0.02) -> SimulatedSegments:
    """Held-out halves of a first-order lag; the model of each half has the gain of the other."""
    rng = np.random.default_rng(3)
    blocks: list[SimulatedSegment] = []
    for k, own in enumerate(sizes):
        u = np.repeat(rng.uniform(-1, 1, 60), 10)[:, None]
        x = np.asarray(lfilter([0.2], [1.0, -0.8], u, axis=0))
        y = own * x + noise * rng.standard_normal(x.shape)
        blocks.append(segment(u, y, sizes[1 - k] * x, 600 * k))
    return SimulatedSegments(tuple(blocks), ("u",), ("y",), 1.0)


def test_a_larger_held_out_error_is_called_drift_where_the_parts_need_other_parameters() -> None:
    found = check_overfit([0.1, 0.1], [0.3, 0.3], _gain_changes((1.0, 1.4)))
    assert found.cause is Cause.PARAMETERS
    assert "drift" in found.sentence
    assert check_overfit([0.1, 0.1], [0.11, 0.1], _gain_changes((1.0, 1.0))).cause is None
    named = check_overfit([0.1, 0.1], [0.3, 0.3], _white_errors(400), apart=("R",))
    assert named.cause is Cause.PARAMETERS
    assert "R differs between the folds by more than noise explains" in named.sentence


def test_a_larger_held_out_error_is_called_overfit_where_too_many_parameters_fit_noise() -> None:
    """An impulse response of 60 samples, fitted to 90 noisy ones in each half."""
    rng = np.random.default_rng(5)
    u = rng.standard_normal((240, 1))
    y = np.asarray(lfilter([0.2], [1.0, -0.8], u, axis=0)) + 0.2 * rng.standard_normal((240, 1))
    past = np.concatenate([np.roll(u, k, axis=0) for k in range(60)], axis=1)
    halves = (slice(60, 150), slice(150, 240))
    blocks: list[SimulatedSegment] = []
    train, held = [], []
    for fit, judge in (halves, halves[::-1]):
        gains = np.linalg.lstsq(past[fit], y[fit], rcond=None)[0]
        train.append(float(np.std(y[fit] - past[fit] @ gains)))
        held.append(float(np.std(y[judge] - past[judge] @ gains)))
        blocks.append(segment(u[judge], y[judge], past[judge] @ gains, judge.start))
    blocks_of_both = SimulatedSegments(tuple(blocks), ("u",), ("y",), 1.0)
    found = check_overfit(train, held, blocks_of_both, parameters=60)
    assert found.cause is Cause.OVERFIT
    assert "too many parameters or too few samples" in found.sentence
