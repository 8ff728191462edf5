"""Linear models with regularised coefficients."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import linear
from asia.models._linear.regularised import fit_regularised
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled

CONTEXT = Context((Signal("u"), Signal("v")), (Signal("y"),), 1.0, 10, 10)
# Gain, radius and angle of a lightly damped mode for each input.
MODES = ((0.3, 0.97, 0.3), (0.2, 0.95, 0.9))


def lightly_damped(samples: int, seed: int, noise: float) -> tuple[Trajectory, np.ndarray]:
    """Record, and its output without noise."""
    rng = np.random.default_rng(seed)
    u = rng.normal((2.0, -1.0), size=(samples, 2))
    y = 5.0 + np.asarray(lfilter([0, 0.1], [1, -0.9], u[:, 1]))
    for column, (gain, radius, angle) in zip(u.T, MODES, strict=True):
        y += np.asarray(lfilter([0, gain], [1, -2 * radius * np.cos(angle), radius**2], column))
    noisy = y + noise * y.std() * rng.normal(size=samples)
    return Trajectory(u, noisy[:, None], 1.0, f"r{seed}"), y


def error(config: linear.Config, training: Trajectory) -> float:
    """Simulation error on a record without noise, in its standard deviations."""
    record, y = lightly_damped(400, 9, 0.0)
    model = linear.train(linear.build(config, CONTEXT), [training], CONTEXT)
    u, past = record.u[None], record.y[None, :10]
    found = model.simulate(u[:, :10], past, u[:, 10:])[0, :, 0]
    return float((found - y[10:])[90:].std() / y.std())


@pytest.mark.parametrize("form", ["response", "equation"])
def test_a_noisy_record_gives_a_model_below_the_noise(form: str) -> None:
    training, _ = lightly_damped(500, 1, 0.5)
    config = linear.Config(regularised=form)  # pyright: ignore[reportArgumentType]
    assert error(config, training) < 0.3


def test_given_states_are_kept_and_few_of_them_suffice_without_noise() -> None:
    training, _ = lightly_damped(600, 2, 0.0)
    records = scaled([training], Scaling.of([training]))
    found = fit_regularised(records, CONTEXT, "equation", 5)
    assert found is not None
    assert found[0].order == 5
    assert error(linear.Config(regularised="equation", order=5), training) < 0.01


def test_an_unstable_equation_leaves_the_usual_fit() -> None:
    rng = np.random.default_rng(3)
    u = rng.normal(size=(120, 2))
    y = np.asarray(lfilter([0, 0.1], [1, -1.06], u[:, 0]))[:, None]
    training = Trajectory(u, y, 1.0, "r")
    assert fit_regularised(scaled([training], Scaling.of([training])), CONTEXT, "equation") is None
    both = [
        linear.train(linear.build(config, CONTEXT), [training], CONTEXT)
        for config in (linear.Config(order=1), linear.Config(order=1, regularised="equation"))
    ]
    plain, other = (m.fitted for m in both)
    assert plain is not None
    assert other is not None
    np.testing.assert_array_equal(plain.system.a, other.system.a)


def test_samples_that_were_not_measured_do_not_count() -> None:
    training, _ = lightly_damped(500, 1, 0.1)
    missing = np.zeros((500, 1), bool)
    missing[200:230] = True
    wrong = np.where(missing, 1e3, training.y)
    gaps = Trajectory(training.u, wrong, 1.0, "r", missing)
    assert error(linear.Config(regularised="response"), gaps) < 0.3


def test_short_records_and_constant_outputs_leave_the_usual_fit() -> None:
    training, _ = lightly_damped(60, 1, 0.1)
    short = Trajectory(training.u[:7], training.y[:7], 1.0, "r")
    constant = Trajectory(training.u, np.ones((60, 1)), 1.0, "r")
    for record in (short, constant):
        records = scaled([record], Scaling.of([record]))
        assert fit_regularised(records, CONTEXT, "response") is None


def test_a_reloaded_model_of_two_outputs_answers_bit_by_bit_the_same() -> None:
    one, _ = lightly_damped(300, 4, 0.1)
    y = np.hstack([one.y, np.roll(one.y, 3, axis=0) + one.u[:, :1]])
    context = Context(CONTEXT.inputs, (Signal("y"), Signal("z")), 1.0, 10, 10)
    config = linear.Config(regularised="response")
    record = Trajectory(one.u, y, 1.0, "r")
    model = linear.train(linear.build(config, context), [record], context)
    assert model.fitted is not None
    assert all(part.flags.c_contiguous for part in model.fitted.system.matrices)
    again = pickle.loads(pickle.dumps(model))
    past = one.u[None, :10], y[None, :10], one.u[None, 10:]
    np.testing.assert_array_equal(model.simulate(*past), again.simulate(*past))


def test_it_stands_alone() -> None:
    with pytest.raises(UserError, match="None beside integrators"):
        linear.Config(regularised="equation", integrators=1)
    with pytest.raises(UserError, match="regularised"):
        linear.Config(regularised="arx")  # pyright: ignore[reportArgumentType]
