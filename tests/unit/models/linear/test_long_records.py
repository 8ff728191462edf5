"""Fits to long records: block by block, with the results of whole records."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear import response
from asia.models._linear import system as linear_system
from asia.models._linear.response import DrivenRecords
from asia.models._linear.system import LinearSystem
from asia.models._noise import model as process
from asia.models._numerics import encoder
from asia.models._numerics.training_records import ScaledTrajectory


def measured(samples: int, seed: int = 0) -> Trajectory:
    """A second-order resonance with noise."""
    rng = np.random.default_rng(seed)
    u, noise = rng.standard_normal((samples, 1)), rng.standard_normal((samples, 1))
    system = LinearSystem(
        np.array([[0.9, 0.3], [-0.3, 0.8]]),
        np.array([[0.0], [0.4]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        np.zeros(1),
    )
    return Trajectory(u, system.simulate(np.zeros((1, 2)), u[None])[1][0] + 0.1 * noise, 1.0)


def context(past: int = 8) -> Context:
    return Context((Signal("u"),), (Signal("y"),), 1.0, past, past)


@pytest.fixture
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(response, "_SHORTEST", 64)
    monkeypatch.setattr(response, "_LONGEST", 64)


@pytest.mark.usefixtures("short_blocks")
@pytest.mark.parametrize("poles", [True, False])
def test_blocks_give_the_normal_equations_of_whole_records(
    monkeypatch: pytest.MonkeyPatch, poles: bool
) -> None:
    rng = np.random.default_rng(1)
    system = LinearSystem(
        0.9 * np.linalg.qr(rng.standard_normal((3, 3)))[0],
        rng.standard_normal((3, 2)),
        rng.standard_normal((2, 3)),
        rng.standard_normal((2, 2)),
        rng.standard_normal(2),
    )
    records = list[ScaledTrajectory]()
    for length in (200, 64, 1, 129):
        u, y = rng.standard_normal((2, length, 2))
        weight = rng.uniform(0.0, 1.0, (length, 2))
        records.append(ScaledTrajectory(u, y, weight, u, np.ones((length, 2))))
    x0, driven = rng.standard_normal((4, 3)), DrivenRecords(records)
    whole, blocks = driven.response(system, x0), driven.response(system, x0)
    expected, misfit = whole.normal_equations(poles=poles), whole.misfit(0)
    monkeypatch.setattr(response, "_LONG", 0)
    found = blocks.normal_equations(poles=poles)
    assert len(list(blocks.states_of(0))) == 4
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)
    assert blocks.error == pytest.approx(whole.error, rel=1e-12)
    np.testing.assert_allclose(blocks.state_squares, whole.state_squares, rtol=1e-12)
    np.testing.assert_allclose(blocks.misfit(0), misfit, atol=1e-9)


@pytest.mark.usefixtures("short_blocks")
def test_a_long_record_has_the_same_fit_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    data, models = measured(700), list[linear.LinearStateSpace]()
    for limit in (10**9, 0):
        monkeypatch.setattr(response, "_LONG", limit)
        monkeypatch.setattr(encoder, "_LONG", limit)
        model = linear.build(linear.Config(order=2), context())
        models.append(linear.train(model, [data], context(), LevenbergMarquardt(iterations=8)))
    u, y = data.u[None], data.y[None]
    whole, blocks = (m.simulate(u[:, :8], y[:, :8], u[:, 8:]) for m in models)
    np.testing.assert_allclose(blocks, whole, atol=1e-9)


@pytest.mark.parametrize("hidden", [0, 6])
@pytest.mark.parametrize("lost", [False, True], ids=["measured", "gaps"])
def test_the_encoder_is_the_same_block_by_block(
    monkeypatch: pytest.MonkeyPatch, hidden: int, lost: bool
) -> None:
    rng = np.random.default_rng(2)
    records, states = list[ScaledTrajectory](), list[Array]()
    for length in (150, 5, 90):
        u, y = rng.standard_normal((2, length, 1))
        counts = np.ones((length, 1))
        counts[20:24] = 0.0 if lost else 1.0
        records.append(ScaledTrajectory(u, y, counts, u, counts))
        states.append(np.cumsum(u, axis=0) * [1.0, 0.1] + np.tanh(3.0 * y))

    def states_of(i: int) -> Iterator[Array]:
        yield states[i][:70]
        if len(states[i]) > 70:
            yield states[i][70:]

    known = encoder.window_encoder(records, states_of, context(), hidden, 1)
    monkeypatch.setattr(encoder, "_LONG", 0)
    monkeypatch.setattr(encoder, "_BLOCK", 16)
    found = encoder.window_encoder(records, states_of, context(), hidden, 1)
    for one, other in zip(vars(known).values(), vars(found).values(), strict=True):
        np.testing.assert_allclose(other, one, atol=1e-10)


@pytest.mark.parametrize("delay", [0, 3, 40])
def test_a_long_simulation_goes_on_from_block_to_block(
    monkeypatch: pytest.MonkeyPatch, delay: int
) -> None:
    data = measured(300)
    model = linear.build(linear.Config(order=2, delay=delay), context())
    model = linear.train(model, [data], context(), LevenbergMarquardt(iterations=1))
    u, y = np.stack([data.u, -data.u]), np.stack([data.y, data.y])
    whole = model.simulate(u[:, :8], y[:, :8], u[:, 8:])
    monkeypatch.setattr(linear_system, "_BLOCK", 32)
    blocks = model.simulate(u[:, :8], y[:, :8], u[:, 8:])
    np.testing.assert_allclose(blocks, whole, atol=1e-12)


def test_standard_errors_of_a_long_record_are_those_of_a_short_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = measured(900)
    model = linear.build(linear.Config(order=2), context())
    model = linear.train(model, [data], context(), LevenbergMarquardt(iterations=30))
    monkeypatch.setattr(process, "_MOST_WORK", 0)
    known = model.estimates([data], context())
    monkeypatch.setattr(response, "_LONG", 0)
    monkeypatch.setattr(process, "_MANY", 0)
    monkeypatch.setattr(process, "_BLOCK", 64)
    found = model.estimates([data], context())
    for one, other in zip(known.parameters, found.parameters, strict=True):
        assert other.standard_error == pytest.approx(one.standard_error, rel=1e-6)


@pytest.mark.long
def test_memory_of_a_fit_grows_little_with_the_record() -> None:
    peaks = list[int]()
    for samples in (60_000, 120_000):
        data = measured(samples)
        model = linear.build(linear.Config(order=4), context(10))
        tracemalloc.start()
        linear.train(model, [data], context(10), LevenbergMarquardt(iterations=1))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 4 * 16 * 60_000
