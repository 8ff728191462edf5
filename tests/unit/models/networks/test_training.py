"""Training methods on networks whose best parameters are known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np
import pytest

from asia.candidate import Model
from asia.errors import UserError
from asia.models import ltc
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.network import NetworkModel, as_built, train_network
from asia.models._numerics.training_records import holdout_records
from asia.models.methods import LBFGS, Adam, MultipleShooting, NetworkMethod
from tests.unit.models.systems.networks import (
    Echo,
    Hidden,
    Plain,
    context,
    error,
    model,
    records,
    start,
)

FAST = Adam(150, 0.03, weight_decay=0.0)


def test_multiple_shooting_fits_where_simulation_from_a_bad_start_diverges() -> None:
    data = records(200)
    shooting = MultipleShooting(300, 0.1, length=20)
    adam = Adam(300, 0.03, weight_decay=0.0)
    found = [train_network(model(1.6, -0.5), data, context(), m) for m in (shooting, adam)]
    assert error(found[0], data[0]) < 0.02
    assert not error(found[1], data[0]) < 0.5


@pytest.mark.slow
def test_multiple_shooting_closes_the_gaps_between_segments() -> None:
    # Noise makes every segment want a start of its own; only the penalty makes one simulation.
    data = records(80, noise=0.2)
    fits = [
        train_network(
            ltc.build(ltc.Config(hidden=3), context()),
            data,
            context(),
            MultipleShooting(100, 0.02, length=10, penalty=p, penalty_start=p),
        )
        for p in (1e-6, 10.0)
    ]
    assert error(fits[1], data[0]) < error(fits[0], data[0])


def test_multiple_shooting_learns_the_map_from_the_past_window() -> None:
    data = records(150)
    start = ltc.build(ltc.Config(hidden=4), context())
    found = train_network(start, data, context(), MultipleShooting(5, length=10))
    for name in ("enc_w1", "enc_w2", "f_h", "out_w"):
        assert not np.array_equal(found.params[name], start.params[name])


def test_multiple_shooting_refuses_a_network_without_state() -> None:
    untrained = NetworkModel(Plain(), {"out_w": np.zeros((1, 1), np.float32)})
    with pytest.raises(UserError, match="no state"):
        train_network(untrained, records(50), context(), MultipleShooting(5))


def test_lbfgs_finds_the_minimum_to_many_digits_in_few_steps() -> None:
    data = records(200, 60)
    logged: list[float] = []
    ctx = context(log=lambda step, loss: logged.append(loss))
    found = train_network(model(), data, ctx, LBFGS(40, ridge=0.0))
    assert error(found, data[0]) < 1e-5
    assert logged[-1] < logged[0]
    assert all(v.dtype == np.float32 for v in jax.tree.leaves(found.params))


def test_lbfgs_ridge_shrinks_the_weights() -> None:
    data = records(100)
    untrained = NetworkModel(Plain(), {"out_w": np.zeros((1, 1), np.float32)})
    weights = [
        float(train_network(untrained, data, context(), LBFGS(20, ridge=r)).params["out_w"][0, 0])
        for r in (0.0, 1.0)
    ]
    # The input has variance one in z-scores: a ridge of one halves the best gain.
    assert weights[1] == pytest.approx(0.5 * weights[0], rel=0.03)


def test_lbfgs_stays_where_it_is_when_nothing_is_finite() -> None:
    untrained = NetworkModel(Plain(), {"out_w": np.full((1, 1), np.inf, np.float32)})
    found = train_network(untrained, records(60), context(), LBFGS(5), as_built)
    assert np.isinf(found.params["out_w"]).all()


@pytest.mark.parametrize("method", [FAST, LBFGS(30), MultipleShooting(200, 0.03, length=20)])
def test_held_out_part_leaves_a_good_fit_and_is_deterministic(method: NetworkMethod) -> None:
    data = records(160, noise=0.05)
    method = replace(method, holdout=0.25)
    found = [train_network(model(), data, context(), method) for _ in range(2)]
    assert error(found[0], data[0]) < 0.2
    for a, b in zip(*(jax.tree.leaves(m.params) for m in found), strict=True):
        assert a.tobytes() == b.tobytes()


def test_whole_records_are_held_out_of_many() -> None:
    assert holdout_records(8, 0.25) == [2, 6]
    assert holdout_records(4, 0.2) == [2]
    assert holdout_records(3, 0.3) == []
    assert holdout_records(4, 0.05) == []
    data = records(60, 60, 60, 60)
    # Record 2 is of another system: fits that see it are worse on the rest.
    data[2] = records(60, 60, 60, a=-0.9)[2]
    asked = train_network(model(), data, context(), replace(FAST, holdout=0.25))
    assert error(asked, data[0]) < error(model_of(asked, 0.2, 0.2), data[0])


def model_of(fitted: NetworkModel, a: float, b: float) -> NetworkModel:
    return replace(fitted, params=start(a, b))


@dataclass
class Oracle:
    """Validation score of a gain or pole: its distance from a target."""

    target: float
    name: str = "a"
    asked: list[float] = field(default_factory=list[float])

    def __call__(self, candidate: Model) -> float:
        assert isinstance(candidate, NetworkModel)
        assert candidate.scaling is not None
        self.asked.append(float(candidate.params[self.name][0]))
        return abs(self.asked[-1] - self.target)


@pytest.mark.parametrize(
    "method",
    [
        Adam(400, 0.01, weight_decay=0.0, schedule="constant"),
        MultipleShooting(400, 0.01, schedule="constant", length=20),
        LBFGS(40),
    ],
)
def test_validation_keeps_the_best_parameters_and_stops(method: NetworkMethod) -> None:
    oracle = Oracle(0.5)
    every = 1 if isinstance(method, LBFGS) else 5
    method = replace(method, stop="validation", every=every, patience=3)
    found = train_network(model(), records(120), context(validation_score=oracle), method)
    scores = [abs(a - 0.5) for a in oracle.asked]
    assert float(found.params["a"][0]) == oracle.asked[int(np.argmin(scores))]
    assert len(scores) == np.argmin(scores) + 1 + 3
    assert len(scores) < method.steps / every


def test_validation_keeps_what_the_fit_starts_from_where_that_is_best() -> None:
    oracle = Oracle(0.2)
    method = Adam(100, 0.05, stop="validation", every=5, patience=3)
    found = train_network(model(), records(120), context(validation_score=oracle), method)
    assert float(found.params["a"][0]) == oracle.asked[0] == pytest.approx(0.2)


def test_validation_without_a_score_runs_all_steps_or_takes_the_held_out_part() -> None:
    data, plain = records(120), replace(FAST, steps=30)
    asked = replace(plain, stop="validation", every=10)
    fits = [train_network(model(), data, context(), m) for m in (plain, asked)]
    assert fits[0].params["a"].tobytes() == fits[1].params["a"].tobytes()
    steps: list[float] = []
    ctx = context(log=lambda step, loss: steps.append(step))
    train_network(model(), data, ctx, replace(asked, holdout=0.25))
    assert steps == [10, 20, 30] * 2


def test_validation_scores_are_asked_for_no_more_often_than_allowed() -> None:
    method = Adam(10_000, stop="validation", every=1, members=2)
    assert len(marks(method, method.steps)) + 1 <= 100


def test_plateau_halves_the_rate_when_the_score_stops_improving() -> None:
    method = Adam(100, 0.1, schedule="plateau", plateau_patience=1)
    scores = iter([1.0, 0.9, 0.9, 0.89999, 0.8, 0.8, 0.8, 0.8, 0.8])
    monitor = Monitor(method, lambda step, loss: None, lambda params: next(scores))
    for step in range(9):
        monitor(step, dict, 1.0)
    expected = [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.025, 0.025, 0.0125]
    np.testing.assert_allclose(monitor.rates, expected)


def test_plateau_rate_is_the_one_that_steps_take() -> None:
    data = records(80)
    # The target is never reached, so that the score gets worse and the rate is halved each time.
    methods = [
        Adam(30, 0.01, 0.0, s, every=5, stop="validation", plateau_patience=0)
        for s in ("constant", "plateau")
    ]
    moved: list[float] = []
    for method in methods:
        oracle = Oracle(-9.0)
        train_network(model(), data, context(validation_score=oracle), method)
        moved.append(oracle.asked[-1] - 0.2)
    # Steps of Adam are about as long as the rate: 30 against 5 (1 + 1 + 1/2 + 1/4 + ...).
    assert moved[0] == pytest.approx(0.3, rel=0.1)
    assert moved[1] == pytest.approx(0.01 * 5 * (2 + 0.5 + 0.25 + 0.125 + 0.0625), rel=0.1)


def test_refit_repeats_the_rates_of_the_search() -> None:
    monitor = Monitor(
        Adam(100, 0.1, schedule="plateau"), lambda step, loss: None, replay=[0.1, 0.02, 0.02]
    )
    for step in range(3):
        monitor(step, dict, 1.0)
    assert monitor.rate == 0.02


def test_members_are_averaged_and_start_from_their_own_seeds() -> None:
    data = records(60)
    method = Adam(3, 0.01)
    together = train_network(
        NetworkModel(Echo(), Echo().parameters(context())), data, context(),
        replace(method, members=3),
    )  # fmt: skip
    alone: list[Any] = []
    past_u, past_y, u = data[0].u[None, :2], data[0].y[None, :2], data[0].u[None, 2:]
    for seed in (5, 6, 7):
        ctx = context(seed=seed)
        one = train_network(NetworkModel(Echo(), Echo().parameters(ctx)), data, ctx, method)
        alone.append(one.simulate(past_u, past_y, u))
    assert alone[0].tobytes() != alone[1].tobytes()
    np.testing.assert_allclose(together.simulate(past_u, past_y, u), sum(alone) / 3, rtol=1e-9)


def test_members_need_a_family_that_starts_from_a_seed() -> None:
    untrained = NetworkModel(Plain(), {"out_w": np.zeros((1, 1), np.float32)})
    with pytest.raises(UserError, match="members"):
        train_network(untrained, records(50), context(), Adam(5, members=2))


def test_fixed_parameters_stay_and_prepare_gives_the_start() -> None:
    @dataclass(frozen=True)
    class Scaled(Echo):
        def step(self, params: Any, state: Any, u: Any) -> Any:
            return super().step(params, state, params["fixed"]["gain"] * u)

    data = records(100)
    fixed = {"gain": np.full(1, 2.0, np.float32)}
    seen: list[Any] = []

    def prepare(params: Any, rows: Any, scaling: Any) -> Any:
        seen.append((len(rows), scaling.u_mean.shape))
        return {**params, "fixed": fixed}

    for method in (replace(FAST, weight_decay=0.1), LBFGS(20), MultipleShooting(20)):
        untrained = NetworkModel(Scaled(), start(0.2, 0.2))
        found = train_network(untrained, data, context(), method, prepare)
        np.testing.assert_array_equal(found.params["fixed"]["gain"], fixed["gain"])
        assert found.params["a"] != untrained.params["a"]
    assert seen == [(1, (1,))] * 3
    found = train_network(NetworkModel(Scaled(), start(0.2, 0.2)), data, context(), FAST, prepare)
    assert error(found, data[0]) < 0.05


@pytest.mark.slow
def test_output_layer_is_solved_for_feature_maps_and_left_alone_in_sequence_maps() -> None:
    data = records(80, a=0.0)
    zeros = {"out_w": np.zeros((4, 1), np.float32), "out_b": np.zeros(1, np.float32)}
    found = train_network(NetworkModel(Hidden(), zeros), data, context(), Adam(1, 1e-9))
    assert error(found, data[0]) < 0.02
    untrained = NetworkModel(Plain(), {"out_w": np.zeros((1, 1), np.float32)})
    found = train_network(untrained, data, context(), FAST)
    assert error(found, data[0]) < 0.1
