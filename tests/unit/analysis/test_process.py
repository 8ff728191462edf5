"""Process models of records: truth found again, intervals that hold it, and the choice of lags."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.analysis.process import ProcessFit, ProcessStructure, fit_process
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.lowering.linear import ProcessModel


def response(model: ProcessModel, u: np.ndarray) -> np.ndarray:
    """Output of a process model for held inputs (T,) from rest, by sums of step responses."""
    y, t = np.zeros(len(u)), np.arange(float(len(u)))
    for k in np.flatnonzero(np.diff(u, prepend=0.0)):
        y[k:] += (u[k] - (u[k - 1] if k else 0.0)) * model.step(t[: len(u) - k])
    return y


def binary(samples: int, seed: int) -> np.ndarray:
    signs = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], samples // 8 + 1), 8)
    signs[:15] = 0.0
    return signs[:samples]


def holds(found: ProcessFit, values: dict[str, float]) -> list[bool]:
    return [one.low <= values[one.name] <= one.high for one in found.parameters[0]]


@pytest.mark.parametrize(
    ("lags", "integrator", "late"),
    [((3.0,), False, 0.4), ((4.0, 1.5), False, 0.0), ((2.0,), True, 1.3)],
)
def test_inputs_that_are_linear_between_samples_are_found_as_such(
    lags: tuple[float, ...], integrator: bool, late: float
) -> None:
    """The output is that of the same input in 100 held parts of a sample."""
    random = np.random.default_rng(0)
    u, fine = random.normal(size=400), np.arange(400 * 100) / 100 - late
    u[0] = 0.0
    inside = np.interp(fine + 0.005, np.arange(400.0), u)
    y = inside
    for lag in lags:
        pole = np.exp(-0.01 / lag)
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
    y = 2.0 * (lfilter([0.0, 0.01], [1.0, -1.0], y) if integrator else y)[::100]
    noisy = y + 0.003 * y.std() * random.normal(size=400)
    record = Trajectory(u[:, None], noisy[:, None], 1.0, "r")
    structure = [ProcessStructure(len(lags), False, integrator)]
    found = fit_process([record], 0, structure)
    assert found.between == ("first",)
    values = [p.value for p in found.parameters[0]]
    assert values == pytest.approx([2.0, *lags, late], rel=0.05, abs=0.05)
    held = fit_process([record], 0, structure, [Signal("u", intersample="zero")])
    assert held.between == ("zero",)
    assert held.fit < found.fit


@pytest.mark.parametrize(
    ("true", "structure"),
    [
        (ProcessModel(2.0, (9.0,), 0.0, 3.4, False, 0.0), ProcessStructure(1)),
        (ProcessModel(-1.5, (12.0, 4.0), 0.0, 0.6, False, 0.0), ProcessStructure(2)),
        (ProcessModel(1.0, (12.0, 4.0), -9.0, 2.2, False, 0.0), ProcessStructure(2, True)),
        (ProcessModel(0.04, (7.0,), 0.0, 5.5, True, 0.0), ProcessStructure(1, False, True)),
        pytest.param(
            ProcessModel(1.0, (15.0, 7.0, 2.5), 0.0, 0.0, False, 0.0),
            ProcessStructure(3),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_intervals_hold_the_truth_and_noise_free_records_give_it_exactly(
    true: ProcessModel, structure: ProcessStructure
) -> None:
    u = binary(500, 1)
    y = response(true, u) + 0.7
    noisy = y + 0.03 * y.std() * np.random.default_rng(2).normal(size=500)
    found = fit_process([Trajectory(u[:, None], noisy[:, None], 1.0, "r")], 0, [structure])
    values = {"gain": true.gain, "delay": true.delay, "zero": true.zero}
    values |= {f"time constant {k}": lag for k, lag in enumerate(true.lags, 1)}
    assert sum(holds(found, values)) >= len(found.parameters[0]) - 1
    exact = fit_process([Trajectory(u[:, None], y[:, None], 1.0, "r")], 0, [structure])
    assert [p.value for p in exact.parameters[0]] == pytest.approx(
        [values[p.name] for p in exact.parameters[0]], rel=5e-3, abs=5e-3
    )


@pytest.mark.long
def test_the_structure_is_chosen_and_records_may_begin_in_motion() -> None:
    true = ProcessModel(2.0, (9.0, 3.0), 0.0, 2.4, False, 0.0)
    u = binary(700, 3)
    y = response(true, u)
    y += 0.02 * y.std() * np.random.default_rng(4).normal(size=700)
    moving = [Trajectory(u[k : k + 300, None], y[k : k + 300, None], 1.0, "r") for k in (60, 380)]
    found = fit_process(moving)
    assert found.models[0] is not None
    assert len(found.models[0].lags) == 2
    assert not found.at_rest
    values = {"gain": 2.0, "delay": 2.4, "time constant 1": 9.0, "time constant 2": 3.0}
    assert all(p.value == pytest.approx(values[p.name], rel=0.1) for p in found.parameters[0])


@pytest.mark.long
def test_two_inputs_and_missing_outputs() -> None:
    first, second = (ProcessModel(2.0, (9.0,), 0.0, 1.0, False, 0.0),
                     ProcessModel(-1.0, (4.0,), 0.0, 3.0, False, 0.0))  # fmt: skip
    u = np.stack([binary(600, 5), binary(600, 6)], axis=1)
    y = response(first, u[:, 0]) + response(second, u[:, 1])
    y += 0.02 * np.random.default_rng(7).normal(size=600)
    y[100:140] = np.nan
    found = fit_process([Trajectory(u, y[:, None], 1.0, "r")])
    assert [m.gain for m in found.models if m] == pytest.approx([2.0, -1.0], rel=0.03)
    assert [m.delay for m in found.models if m] == pytest.approx([1.0, 3.0], abs=0.15)


def test_records_without_a_change_are_refused() -> None:
    u = binary(100, 8)[:, None]
    with pytest.raises(UserError, match="the output does not change"):
        fit_process([Trajectory(u, np.ones((100, 1)), 1.0, "r")])
    with pytest.raises(UserError, match="too few"):
        fit_process([Trajectory(u[:12], u[:12] + np.arange(12.0)[:, None], 1.0, "r")])


def delayed(powers: tuple[int, ...] = (0, 0, 0), seed: int = 0) -> Trajectory:
    """Inputs with responses after 2, 5 and 9 samples and lags of 4, 12 and 2 samples; the output
    and inputs in units of powers of ten."""
    rng = np.random.default_rng(seed)
    u = np.stack([binary(700, seed + k) for k in (1, 2)], axis=1)
    models = [ProcessModel(2.0, (4.0,), 0.0, 1.0, False, 0.0),
              ProcessModel(-1.0, (12.0,), 0.0, 8.0, False, 0.0)]  # fmt: skip
    y = sum((response(m, v) for m, v in zip(models, u.T, strict=True)), np.zeros(700))
    y = y + 0.03 * rng.normal(size=700)
    return Trajectory(u * 10.0 ** np.array(powers[1:]), y[:, None] * 10.0 ** powers[0], 1.0, "r")


def test_each_input_has_its_own_lag_and_delay() -> None:
    found = fit_process([delayed()])
    assert found.first == (2, 9)
    assert found.withheld == ("", "")
    lags = [m.lags for m in found.models if m]
    assert [len(one) for one in lags] == [1, 1]
    assert [one[0] for one in lags] == pytest.approx([4.0, 12.0], rel=0.05)


@pytest.mark.parametrize("powers", [(-12, 0, 0), (12, 3, -6)])
def test_estimates_follow_the_units_of_the_signals(powers: tuple[int, int, int]) -> None:
    plain, scaled = fit_process([delayed()]), fit_process([delayed(powers)])
    assert scaled.first == plain.first
    for one, other, power in zip(plain.parameters, scaled.parameters, powers[1:], strict=True):
        for p, q in zip(one, other, strict=True):
            unit = 10.0 ** (powers[0] - power) if p.name == "gain" else 1.0
            for name in ("value", "low", "high"):
                assert getattr(q, name) == pytest.approx(getattr(p, name) * unit, rel=1e-6)


def test_shifted_and_exchanged_signals_have_the_same_delays() -> None:
    record = delayed()
    moved = Trajectory(record.u[:, ::-1] + 500.0, 1e6 - record.y, 1.0, "r")
    plain, other = fit_process([record]), fit_process([moved])
    assert other.first == plain.first[::-1]
    gains = [-p[0].value for p in other.parameters[::-1]]
    assert gains == pytest.approx([p[0].value for p in plain.parameters], rel=1e-5)


def test_statements_are_withheld_from_an_input_without_effect_and_a_poor_fit() -> None:
    rng = np.random.default_rng(5)
    u = np.stack([binary(500, 1), binary(500, 2), np.full(500, 3.0)], axis=1)
    y = response(ProcessModel(2.0, (9.0,), 0.0, 3.0, False, 0.0), u[:, 0])
    found = fit_process([Trajectory(u, (y + 0.05 * rng.normal(size=500))[:, None], 1.0, "r")])
    assert found.models[0] is not None
    assert found.withheld[1:] == ("no effect of the input is seen", "the input does not move")
    noisy = fit_process([Trajectory(u, (y + y.std() * rng.normal(size=500))[:, None], 1.0, "r")])
    assert noisy.models[0] is None
    assert "below 80 %" in noisy.withheld[0]


def test_a_noise_free_record_in_motion_at_its_start_gives_the_lags_that_made_it() -> None:
    """The filter of the noise does not take what a missing lag leaves for noise."""
    true = ProcessModel(1.5, (6.0, 3.0), 0.0, 0.0, False, 0.0)
    u = np.repeat(np.random.default_rng(3).uniform(-1, 1, 70), 6)[:400]
    found = fit_process([Trajectory(u[:, None], response(true, u)[:, None], 1.0, "r")])
    assert found.models[0] is not None
    assert found.models[0].lags == pytest.approx((6.0, 3.0), rel=1e-3)
    assert found.fit > 99.9
