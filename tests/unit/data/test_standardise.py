"""Each fit standardises its own training records, and its model takes and gives the problem's
units."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asia.candidate import Context, simulate_steps
from asia.data import Array, Signal, Trajectory
from asia.data.standardise import Standardised, StandardisedSteps, standardised
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, ProtocolRule

CONTEXT = Context((Signal("u"),), (Signal("y"), Signal("z")), 1.0, 2, 2, detrend=True, scale=True)
LAG, LEVEL, SIZE = 0.8, np.array([300.0, -2.0]), np.array([0.01, 7.0])


class Lag:
    """First-order lag of the input, for both outputs; computes in single precision if asked."""

    def __init__(self, kind: type = np.float64) -> None:
        self.kind = kind

    def initial(self, past_u: Array, past_y: Array, u: Array) -> Array:
        return past_y[:, -1]

    def step(self, state: Array, u: Array) -> tuple[Array, Array]:
        return LAG * state + (1 - LAG) * u, state.astype(self.kind)

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        return simulate_steps(self, past_u, past_y, u)

    def parameters(self) -> dict[str, float]:
        return {"lag": LAG}


def record(seed: int, samples: int = 120) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        5000.0 + rng.normal(size=samples), LEVEL + SIZE * rng.normal(size=(samples, 2)), 1.0, "r"
    )


def test_the_records_of_a_fit_have_mean_0_and_deviation_1() -> None:
    y = record(1).y.copy()
    y[5:40, 0] = np.nan
    parts = [Trajectory(record(1).u, y, 1.0), record(2)]
    found, _, _ = standardised(parts, CONTEXT)
    for side in ("u", "measured_y"):
        values = np.concatenate([getattr(t, side) for t in found])
        np.testing.assert_allclose(np.nanmean(values, axis=0), 0.0, atol=1e-9)
        np.testing.assert_allclose(np.nanstd(values, axis=0), 1.0, rtol=1e-9)
    assert found[0].missing is not None
    assert np.array_equal(found[0].missing, parts[0].missing)


def test_nothing_is_done_without_the_setting() -> None:
    records, model = [record(1)], Lag()
    found, context, restored = standardised(records, replace(CONTEXT, detrend=False, scale=False))
    assert found is records
    assert context == replace(CONTEXT, detrend=False, scale=False)
    assert restored(model) is model


def test_a_signal_that_does_not_move_is_not_divided() -> None:
    still = Trajectory(np.full(50, 0.1), record(1).y[:50], 1.0)
    found, _, _ = standardised([still], CONTEXT)
    np.testing.assert_allclose(found[0].u, 0.0, atol=1e-15)


def held_out_changed(t: Trajectory, fold: Any) -> Trajectory:
    """The record with other outputs in what the fold holds out."""
    y = t.y.copy()
    for block in fold.held_out:
        y[block.start : block.stop] = 10.0 * LEVEL + 3.0 * y[block.start : block.stop]
    return Trajectory(t.u, y, t.sampling_time, t.name)


@pytest.mark.parametrize("kind", ["contiguous", "forward"])
def test_a_fit_is_bitwise_the_same_whatever_the_held_out_outputs(kind: Any) -> None:
    rule = ProtocolRule(folds=FoldRule(kind, 3), past_inputs=2, past_outputs=2)
    t = record(4, 300)
    for k, fold in enumerate(make_folds([t], rule)):
        other = make_folds([held_out_changed(t, fold)], rule)[k]
        assert not np.array_equal(other.held_out[0].y, fold.held_out[0].y)
        fits = [standardised(list(f.train), CONTEXT) for f in (fold, other)]
        for one, same in zip(fits[0][0], fits[1][0], strict=True):
            assert one.y.tobytes() == same.y.tobytes()
            assert one.u.tobytes() == same.u.tobytes()
        models = [restored(Lag()) for *_, restored in fits]
        assert pickle.dumps(models[0]) == pickle.dumps(models[1])


def test_a_model_takes_and_gives_the_units_of_the_problem() -> None:
    t = record(3)
    _, _, restored = standardised([t], CONTEXT)
    model = pickle.loads(pickle.dumps(restored(Lag())))
    assert isinstance(model, StandardisedSteps)
    past_u, past_y, u = t.u[None, :2], t.y[None, :2], t.u[None, 2:]
    y_hat = model.simulate(past_u, past_y, u)
    np.testing.assert_array_equal(y_hat[0, 0], t.y[1])
    np.testing.assert_allclose(simulate_steps(model, past_u, past_y, u), y_hat, rtol=1e-14)
    # The gain is that of the standardised signals, back in units.
    still = model.simulate(past_u, past_y, np.full((1, 400, 1), t.u.mean() + t.u.std()))
    np.testing.assert_allclose(still[0, -1], t.y.mean(axis=0) + t.y.std(axis=0), rtol=1e-12)


def test_single_precision_does_not_lose_a_small_signal_on_a_large_offset() -> None:
    t = record(3)
    _, _, restored = standardised([t], CONTEXT)
    case = t.u[None, :2], t.y[None, :2], t.u[None, 2:]
    exact, single = (restored(Lag(kind)).simulate(*case) for kind in (np.float64, np.float32))
    assert (np.abs(exact - single) / t.y.std(axis=0)).max() < 1e-6


def test_parameters_are_kept_only_where_folds_have_one_unit() -> None:
    for scale, found in ((False, {"lag": LAG}), (True, {})):
        _, _, restored = standardised([record(3)], replace(CONTEXT, scale=scale))
        assert restored(Lag()).parameters() == found


class Answers:
    """Gives anything as its simulation."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Any:
        return self.answer


@pytest.mark.parametrize(
    "answer", ["text", None, [[1.0], [2.0, 3.0]], np.ones((1, 4, 1)), np.ones((1, 4, 2)) * 1j]
)
def test_what_is_no_simulation_reaches_the_worker_unchanged(answer: Any) -> None:
    """A wrong width must not become the right one by broadcasting."""
    _, _, restored = standardised([record(3)], CONTEXT)
    model = restored(Answers(answer))
    assert type(model) is Standardised
    found = model.simulate(np.zeros((1, 2, 1)), np.zeros((1, 2, 2)), np.zeros((1, 4, 1)))
    if isinstance(answer, np.ndarray):
        np.testing.assert_array_equal(found, answer)
    else:
        assert np.array_equal(np.array(found, dtype=object), np.array(answer, dtype=object))


def test_a_validation_score_is_of_the_model_in_units() -> None:
    asked: list[Any] = []

    def score(model: Any) -> float:
        asked.append(model)
        return 0.5

    _, context, _ = standardised([record(3)], replace(CONTEXT, validation_score=score))
    assert context.validation_score is not None
    assert context.validation_score(Lag()) == 0.5
    assert isinstance(asked[0], StandardisedSteps)
