"""First-order training: chunks, held-out blocks, skipped steps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.errors import UserError
from asia.models import ltc
from asia.models._networks import training
from asia.models._networks.network import NetworkModel, as_built, train_network
from asia.models._networks.objective import objective
from asia.models._networks.structure import Params
from asia.models._networks.training import FitTask, HoldoutSplit
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import laid
from asia.models._numerics.training_records import (
    SegmentBatch,
    batch,
    holdout_masks,
    reweighted,
    scaled,
)
from asia.models.methods import Adam
from tests.unit.models.systems.black_box import Case, case, filtered
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


@dataclass(frozen=True)
class Gain:
    """y = w u: a model without memory, whose best gain is known."""

    def initial(self, params: Any, window: jax.Array) -> jax.Array:
        del params
        return window[:, :1]

    def step(self, params: Any, state: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        del params
        return state, u

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        del u
        return features * params["w"]


def records_of(data: Case, gain: float) -> SegmentBatch:
    scaling = Scaling.of(data.training)
    records = scaled(data.training, scaling)
    return batch([replace(r, y=gain * r.u) for r in records], data.context)


def silent(step: float, loss: float) -> None:
    del step, loss


def trained(
    samples: SegmentBatch | HoldoutSplit, method: Adam, cell: Any = None, **task: Any
) -> Params:
    """A gain of zero, trained."""
    start = task.pop("start", {"w": np.zeros(1, np.float32)})
    settings = {"horizon": None, "seed": 0, "log": silent, **task}
    with jax.enable_x64(False):
        return training.train(FitTask(cell or Gain(), samples, **settings), start, method)


@pytest.mark.parametrize("truncation", [None, 30])
def test_finds_the_minimum_with_records_of_unequal_length(truncation: int | None) -> None:
    data = case(filtered, lengths=(100, 60, 40))
    method = Adam(300, 0.05, weight_decay=0.0, truncation=truncation)
    found = trained(records_of(data, 1.7), method)
    assert found["w"] == pytest.approx(1.7, abs=0.02)


def test_records_shorter_than_a_chunk_are_learned_from() -> None:
    both = records_of(case(filtered, lengths=(100, 40)), 1.7)
    u, y = both.u.copy(), both.y.copy()
    u[0], y[0] = 0.0, 0.0
    method = Adam(300, 0.05, weight_decay=0.0, truncation=60)
    found = trained(both._replace(u=u, y=y), method)
    assert found["w"] == pytest.approx(1.7, abs=0.02)


def test_a_constant_offset_of_the_inputs_is_seen() -> None:
    """Errors in the input as large as the input halve the best gain."""
    data = records_of(case(filtered, lengths=(300,)), 1.0)
    method = Adam(400, 0.02, weight_decay=0.0, truncation=30, batch=64, offset=1.0)
    assert trained(data, method)["w"] == pytest.approx(0.5, abs=0.12)


def test_gentle_chunks_are_drawn_more_often() -> None:
    both = records_of(case(filtered, lengths=(100, 100)), 1.0)
    wild = np.array([1.0, 10.0])[:, None, None]
    both = both._replace(u=wild * both.u, y=np.array([1.0, 30.0])[:, None, None] * both.y)
    method = Adam(300, 0.05, weight_decay=0.0, truncation=30)
    assert trained(both, method)["w"] > 2.5
    assert trained(both, replace(method, gentle=6.0))["w"] == pytest.approx(1.0, abs=0.1)


def test_samples_without_weight_do_not_count() -> None:
    data = case(filtered, lengths=(100, 60))
    clean = records_of(data, 1.0)
    y = clean.y.copy()
    y[0, 20:60] = 1e3
    weight = clean.weight.copy()
    weight[0, 20:60] = 0.0
    method = Adam(20, 0.05)
    found = [trained(clean._replace(y=values, weight=weight), method) for values in (clean.y, y)]
    assert found[0]["w"] == found[1]["w"]


def test_held_out_blocks_pick_the_number_of_steps() -> None:
    data = case(filtered, lengths=(100,))
    fitted = records_of(data, 1.0)
    # The held-out samples want half the gain: passed on the way up, so fewer steps are best.
    held_out = fitted._replace(y=0.5 * fitted.y)
    method = Adam(100, 0.02, weight_decay=0.0, schedule="constant")
    found = trained(HoldoutSplit(fitted, held_out, fitted), method)
    whole = trained(fitted, method)
    assert found["w"] == pytest.approx(0.5, abs=0.1)
    assert whole["w"] == pytest.approx(1.0, abs=0.1)


def test_few_steps_are_picked_among_those_that_were_tried() -> None:
    data = case(filtered, lengths=(100,))
    fitted = records_of(data, 1.0)
    held_out = fitted._replace(y=0.5 * fitted.y)
    method = Adam(10, 0.1, weight_decay=0.0, schedule="constant")
    reported: list[float] = []

    def log(step: float, loss: float) -> None:
        del loss
        reported.append(step)

    found = trained(HoldoutSplit(fitted, held_out, fitted), method, log=log)
    assert found["w"] == pytest.approx(0.5, abs=0.05)
    assert reported == [*range(1, 11), *range(1, 6)]


def test_masks_hold_out_the_fraction_all_over_the_record() -> None:
    data = case(filtered, lengths=(400, 90))
    records = scaled(data.training, Scaling.of(data.training))
    masks = holdout_masks(records, 0.25)
    for mask in masks:
        assert mask.mean() == pytest.approx(0.25, abs=0.05)
        assert all(part.any() for part in np.array_split(mask, 4))
    kept, left = reweighted(records, masks, False), reweighted(records, masks, True)
    for a, b in zip(kept, left, strict=True):
        np.testing.assert_array_equal(a.weight + b.weight, 1.0)


def test_step_with_a_gradient_that_is_not_finite_is_skipped() -> None:
    data = case(filtered, lengths=(60,))
    clean = records_of(data, 1.0)
    broken = clean._replace(y=np.full_like(clean.y, np.inf))
    start = {"w": np.full(1, 0.25, np.float32)}
    found = trained(broken, Adam(5), start=start)
    assert found["w"] == pytest.approx(0.25)


def test_log_shows_a_falling_loss() -> None:
    data = case(filtered, lengths=(150,))
    curve: list[tuple[float, float]] = []

    def log(step: float, loss: float) -> None:
        curve.append((step, loss))

    context = replace(data.context, log=log)
    model = ltc.build(ltc.Config(hidden=8), context)
    ltc.train(model, data.training, context, Adam(steps=100, learning_rate=1e-2, holdout=0.25))
    steps = [step for step, _ in curve]
    assert max(steps) == 100
    assert curve[-1][1] < curve[0][1]


def test_network_is_trained_in_single_precision_inside_a_double_precision_process() -> None:
    data = case(filtered, lengths=(60,))
    with jax.enable_x64(True):
        assert jnp.ones(1).dtype == jnp.float64
        model = ltc.build(ltc.Config(hidden=4), data.context)
        found = ltc.train(model, data.training, data.context, Adam(steps=2))
        assert all(v.dtype == np.float32 for v in jax.tree.leaves(found.params))


@pytest.mark.slow
def test_teacher_forcing_learns_from_a_start_whose_simulation_diverges() -> None:
    data = records(200)
    plain = Adam(300, 0.03, weight_decay=0.0)
    forced = replace(plain, teacher=1.0, teacher_end=1.0)
    found = [train_network(model(1.6, -0.5), data, context(), m) for m in (forced, plain)]
    assert error(found[0], data[0]) < 0.05
    assert not error(found[1], data[0]) < 0.5


@pytest.mark.long
def test_probability_of_the_teacher_falls_from_its_start_to_its_end() -> None:
    data = records(100)
    methods = [
        Adam(40, 0.01, teacher=first, teacher_end=last)
        for first, last in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    ]
    fits = [train_network(model(), data, context(), m).params["a"][0] for m in methods]
    assert len(set(fits)) == 3


def test_teacher_never_shows_samples_that_do_not_count() -> None:
    data = batch(scaled(records(80), Scaling.of(records(80))), context())
    weight = data.weight.copy()
    weight[:, 30:50] = 0.0
    hidden = data.y.copy()
    hidden[:, 30:50] = 7.0
    method = Adam(10, 0.01, teacher=1.0, teacher_end=1.0)
    begin = start(0.2, 0.2)
    found = [
        trained(data._replace(y=y, weight=weight), method, Echo(), start=begin)
        for y in (data.y, hidden)
    ]
    assert found[0]["a"] == found[1]["a"]


def test_chunks_laid_end_to_end_are_the_published_windows() -> None:
    samples = batch(scaled(records(151, 80), Scaling.of(records(151, 80))), context())
    data = laid(samples, 40)
    # 149 samples after the past window make four windows, the last one ending with the record.
    assert data.u.shape == (4 + 2, 40, 1)
    np.testing.assert_allclose(data.y[3], samples.y[0, 109:149], rtol=1e-6)
    np.testing.assert_allclose(data.y[5], samples.y[1, 38:78], rtol=1e-6)
    np.testing.assert_allclose(data.window[1, -1], samples.y[0, 39, 0], rtol=1e-6)
    assert float(data.weight.min()) == 1.0


@dataclass(frozen=True)
class Probe:
    """Remembers the shapes it was asked to simulate."""

    shapes: list[tuple[int, ...]] = field(default_factory=list[tuple[int, ...]], hash=False)

    def sequence(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        del window
        self.shapes.append(u.shape)
        return u * params["w"]


@pytest.mark.parametrize(
    ("horizon", "method", "expected"),
    [
        (None, Adam(1), (1, 998, 1)),
        (20, Adam(1), (49, 20, 1)),
        (5, Adam(1), (128, 5, 1)),
        (20, Adam(1, batch=3), (3, 20, 1)),
        (20, Adam(1, truncation=30), (33, 30, 1)),
        (20, Adam(1, full_batch=True), (50, 20, 1)),
    ],
)
def test_a_step_sees_windows_of_the_horizon(
    horizon: int | None, method: Adam, expected: tuple[int, ...]
) -> None:
    samples = batch(scaled(records(1000), Scaling.of(records(1000))), context())
    probe = Probe()
    trained(samples, method, probe, horizon=horizon)
    assert set(probe.shapes) == {expected}


@pytest.mark.slow
def test_losses_are_what_their_names_say() -> None:
    residual = jnp.array([[[0.5], [-3.0], [1.0], [2.0]]])
    weight = jnp.array([[[1.0], [1.0], [0.0], [1.0]]])
    for loss, each in (
        ("mse", [0.25, 9.0, 4.0]),
        ("mae", [0.5, 3.0, 2.0]),
        ("huber", [0.25, 5.0, 3.0]),
    ):
        assert float(objective(loss, residual, weight)) == pytest.approx(np.mean(each))  # type: ignore[arg-type]
    several = objective("mse", residual, weight, (1, 2, 50))
    assert float(several) == pytest.approx(np.mean([0.25, 9.25 / 2, 13.25 / 3]))


def test_robust_loss_is_less_moved_by_an_outlier() -> None:
    data = records_of(case(filtered, lengths=(100,)), 1.0)
    y = data.y.copy()
    y[0, 10] = 60.0 * np.sign(data.u[0, 10])
    found = [
        float(trained(data._replace(y=y), Adam(400, 0.02, 0.0, loss=loss))["w"][0])
        for loss in ("mse", "huber", "mae")
    ]
    assert abs(found[2] - 1.0) < abs(found[1] - 1.0) < abs(found[0] - 1.0)
    assert found[2] == pytest.approx(1.0, abs=0.03)


@pytest.mark.long
def test_dropout_acts_in_training_alone_and_keeps_the_mean() -> None:
    data = records(200, a=0.0)
    zeros = {"out_w": np.zeros((4, 1), np.float32), "out_b": np.zeros(1, np.float32)}
    method = Adam(500, 0.02, weight_decay=0.0, truncation=20)
    fits = [
        train_network(NetworkModel(Hidden(), zeros), data, context(), m, as_built)
        for m in (method, replace(method, dropout=0.5))
    ]
    assert error(fits[0], data[0]) < 0.02
    # Of four equal features, half of them dropped: ridge regression that shrinks the gain to 4/5.
    gains = [float(m.params["out_w"].sum()) for m in fits]
    assert gains[1] / gains[0] == pytest.approx(0.8, abs=0.1)
    sequence = NetworkModel(Plain(), {"out_w": np.zeros((1, 1), np.float32)})
    dropped = train_network(sequence, data, context(), replace(method, dropout=0.5))
    assert float(dropped.params["out_w"][0, 0]) / gains[0] == pytest.approx(0.5, abs=0.1)


def test_average_trails_behind_the_weights() -> None:
    data = records_of(case(filtered, lengths=(100,)), 9.0)
    method = Adam(100, 0.01, weight_decay=0.0, schedule="constant")
    last = float(trained(data, method)["w"][0])
    mean = float(trained(data, replace(method, average=0.9))["w"][0])
    # Ten steps of 0.01 behind.
    assert last - mean == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"schedule": "linear"}, "cosine, constant or plateau"),
        ({"noise": -0.1}, "noise"),
        ({"gentle": -0.5}, "gentle"),
        ({"offset": -0.1}, "offset"),
        ({"dropout": 1.0}, "dropout is 1.0"),
        ({"average": 1.0}, "average"),
        ({"teacher": 1.5}, "teacher is 1.5"),
        ({"batch": 0}, "batch is 0"),
        ({"loss": "rmse"}, "mse, mae or huber"),
        ({"holdout": 0.95}, "holdout is 0.95"),
        ({"stop": "inner"}, "None or 'validation'"),
        ({"members": 0}, "members is 0"),
        ({"every": 0}, "every is 0"),
        ({"patience": 0}, "patience is 0"),
        ({"horizons": ()}, "horizons"),
        ({"horizons": (0, 10)}, "horizons"),
        ({"full_batch": True, "batch": 3}, "leave batch out"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        Adam(**settings)


def test_settings_that_do_not_go_with_the_network_are_refused() -> None:
    data = records(50)
    sequence = NetworkModel(Plain(), {"w": np.zeros((1, 1), np.float32)})
    for method, words in (
        (Adam(1, teacher=0.5), "feed back their own output"),
        (Adam(1, dropout=0.5), "needs an output layer"),
    ):
        with pytest.raises(UserError, match=words):
            train_network(sequence, data, context(), method)
