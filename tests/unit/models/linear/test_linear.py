"""Linear state-space models."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from asia.data import Trajectory
from asia.errors import UserError
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import (
    Refinement,
    encoder_of,
    refine,
    solve_linear_part,
    spread_poles,
    unseen_error,
)
from asia.models._linear.response import DrivenRecords
from asia.models._linear.system import LinearSystem
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledTrajectory, scaled
from tests.unit.models.systems.black_box import Case, case, filtered, late, two_by_two


def fitted(config: linear.Config, data: Case) -> linear.LinearStateSpace:
    return linear.train(linear.build(config, data.context), data.training, data.context)


@pytest.mark.slow
def test_chosen_order_simulates_below_the_noise() -> None:
    data = case(filtered)
    model = fitted(linear.Config(), data)
    assert data.ratio(model) < 0.4
    assert model.fitted is not None
    assert model.fitted.system.order == 2


def test_gain_time_constants_and_delay_are_named_in_physical_units() -> None:
    a = np.diag([0.9, 0.5])
    system = LinearSystem(a, np.ones((2, 1)), np.array([[1.0, 1.0]]), np.zeros((1, 1)), np.zeros(1))
    scaling = Scaling(np.zeros(1), np.array([2.0]), np.zeros(1), np.array([3.0]))
    data = case(filtered)
    model = fitted(linear.Config(order=2, delay=0), data)
    assert model.fitted is not None
    known = replace(model.fitted, system=system, delay=4, scaling=scaling)
    found = linear.LinearStateSpace(linear.Config(), known).parameters()
    assert found["gain y1/u1"] == pytest.approx((10.0 + 2.0) * 3.0 / 2.0)
    assert found["time constant 1 [samples]"] == pytest.approx(-1 / np.log(0.9))
    assert found["delay [samples]"] == 4.0
    # A pole that no record tells from an integrator has neither a gain nor a time constant.
    slow = replace(known, system=LinearSystem(np.diag([1.0 - 1e-8, 0.5]), *system.matrices[1:]))
    found = linear.LinearStateSpace(linear.Config(), slow).parameters()
    assert found["integrators"] == 1.0
    assert found["time constant 1 [samples]"] == pytest.approx(-1 / np.log(0.5))
    assert "gain y1/u1" not in found
    # An oscillation at 0.05 cycles a sample that decays in 100 samples.
    turn = 2 * np.pi * 0.05
    pair = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    lightly = LinearSystem(np.exp(-0.01) * np.array(pair), *system.matrices[1:])
    oscillating = replace(model.fitted, system=lightly)
    found = linear.LinearStateSpace(linear.Config(), oscillating).parameters()
    assert found["frequency 1 [1/sample]"] == pytest.approx(0.05, rel=1e-3)
    assert found["damping 1"] == pytest.approx(0.01 / turn, rel=1e-3)
    assert not any(name.startswith("time constant") for name in found)
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    integrator = LinearSystem(one, one, one, zero, np.zeros(1))
    assert not np.isfinite(integrator.gain).any()
    found = linear.LinearStateSpace(
        linear.Config(), replace(model.fitted, system=integrator)
    ).parameters()
    assert not any(name.startswith(("time constant", "frequency")) for name in found)


def test_two_inputs_and_outputs_from_records_of_unequal_length() -> None:
    data = case(two_by_two, channels=2, lengths=(250, 120, 60))
    assert data.ratio(fitted(linear.Config(order=3), data)) < 0.5


@pytest.mark.parametrize(
    ("lengths", "past"), [((60, 60, 12000, 12000), 10), ((200,) * 60, 50)], ids=["uneven", "many"]
)
@pytest.mark.long
def test_order_and_delay_are_chosen_on_uneven_or_many_records(
    lengths: tuple[int, ...], past: int
) -> None:
    data = case(filtered, lengths=lengths)
    context = replace(data.context, n_past_u=past, n_past_y=past)
    model = linear.build(linear.Config(delay=None), context)
    model = linear.train(model, data.training, context, LevenbergMarquardt(iterations=2))
    assert model.fitted is not None
    assert (model.fitted.system.order, model.fitted.delay) == (2, 0)
    u, y = data.unseen.u[None], data.unseen.y[None]
    y_hat = model.simulate(u[:, :past], y[:, :past], u[:, past:])[0]
    assert np.sqrt(np.mean((y_hat - data.truth[past:]) ** 2)) < 0.1 * data.noise[0]


def test_records_no_longer_than_the_past_window_tell_nothing_of_the_order() -> None:
    data = case(filtered)
    records = scaled(data.training, Scaling.of(data.training))
    found = refine(records, solve_linear_part(records, *spread_poles(2, 1)), Refinement(2))
    encoder = encoder_of(records, found, data.context)
    short = scaled([data.training[0][:8]], Scaling.of(data.training))
    alone = unseen_error(records, found, encoder, data.context)
    assert unseen_error([*short, *records], found, encoder, data.context) == alone


def test_delay_is_estimated() -> None:
    data = case(late)
    model = fitted(linear.Config(order=2, delay=None), data)
    assert model.fitted is not None
    # The system itself has one more sample of delay than its feedthrough could express.
    assert model.fitted.delay in (5, 6)
    assert data.ratio(model) < 0.5


def test_past_window_sets_the_initial_state() -> None:
    data = case(filtered, noise=0.01)
    model = fitted(linear.Config(order=2), data)
    first = np.abs(data.simulated(model)[:10] - data.truth[8:18]).max()
    assert first < 0.1 * data.truth.std()


def test_convolution_gives_the_states_of_the_recursion() -> None:
    rng = np.random.default_rng(0)
    system = LinearSystem(
        0.9 * np.linalg.qr(rng.standard_normal((3, 3)))[0],
        rng.standard_normal((3, 2)),
        rng.standard_normal((1, 3)),
        np.zeros((1, 2)),
        np.zeros(1),
    )
    records = [
        ScaledTrajectory(u, np.zeros((len(u), 1)), np.ones((len(u), 1)), u, np.ones((len(u), 1)))
        for u in (rng.standard_normal((length, 2)) for length in (77, 70, 300, 1))
    ]
    x0 = rng.standard_normal((4, 3))
    response = DrivenRecords(records).response(system, x0)
    for i, (record, start) in enumerate(zip(records, x0, strict=True)):
        (states,) = response.states_of(i)
        by_recursion = system.simulate(start[None], record.u[None])[0][0]
        np.testing.assert_allclose(states, by_recursion, atol=1e-10)


def test_refinement_lowers_the_simulation_error_and_ignores_unweighted_samples() -> None:
    data = case(filtered, noise=0.2)
    t = data.training[0]
    weight = np.ones((len(t), 1))
    weight[100:150] = 0.0
    y = (t.y - t.y.mean()) / t.y.std()
    u = t.u - t.u.mean()
    record = ScaledTrajectory(u, y, weight, u, np.ones((len(u), 1)))
    start = solve_linear_part([record], *spread_poles(2, 1))
    better = refine([record], start, Refinement())
    assert better.error < 0.9 * start.error
    spoiled = y.copy()
    spoiled[100:150] = 1e3
    seen = DrivenRecords([replace(record, y=spoiled)]).response(better.system, better.x0)
    assert seen.error == pytest.approx(better.error)


def test_integrator_stays_simulable() -> None:
    rng = np.random.default_rng(2)
    u = rng.standard_normal((300, 1))
    y = np.cumsum(0.1 * u, axis=0)
    data = case(filtered)
    t = [Trajectory(u, y, 1.0)]
    model = linear.train(linear.build(linear.Config(order=1), data.context), t, data.context)
    y_hat = model.simulate(u[None, :8], y[None, :8], u[None, 8:])
    assert np.abs(y_hat[0] - y[9 - 1 :]).max() < y.std()


def test_record_shorter_than_its_past_window_is_refused() -> None:
    data = case(filtered)
    short = [data.training[0][:8]]
    with pytest.raises(UserError, match="past window of 8"):
        linear.train(linear.build(linear.Config(order=1), data.context), short, data.context)


def test_untrained_model_says_so() -> None:
    data = case(filtered)
    with pytest.raises(UserError, match="not trained"):
        data.simulated(linear.build(linear.Config(), data.context))


def test_package_loads_no_numerical_library() -> None:
    program = "import sys, asia.models; sys.exit('jax' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_families_load_no_scipy() -> None:
    # Each worker would spend half a second on it.
    program = """import sys
from asia.models import arx, greybox, linear, narx, neural_ss, nl_lfr, recurrent
sys.exit(any(name in sys.modules for name in ("scipy.signal", "scipy.optimize", "scipy.stats")))"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
