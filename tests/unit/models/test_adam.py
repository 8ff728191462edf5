"""First-order training: chunks, held-out blocks, skipped steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.models import ltc
from asia.models._adam import train_adam
from asia.models._records import Batch, batch, holdout_masks, reweighted, scaled
from asia.models._scaling import Scaling
from asia.models.methods import Adam
from tests.unit.models.black_box_systems import Case, case, filtered


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


def records_of(data: Case, gain: float) -> Batch:
    scaling = Scaling.of(data.training)
    records = scaled(data.training, scaling)
    return batch([replace(r, y=gain * r.u) for r in records], data.context)


def silent(step: float, loss: float) -> None:
    del step, loss


@pytest.mark.parametrize("truncation", [None, 30])
def test_finds_the_minimum_with_records_of_unequal_length(truncation: int | None) -> None:
    data = case(filtered, lengths=(100, 60, 40))
    method = Adam(300, 0.05, weight_decay=0.0, truncation=truncation)
    start = {"w": np.zeros(1, np.float32)}
    found = train_adam(Gain(), start, records_of(data, 1.7), None, method, 0, silent)
    assert found["w"] == pytest.approx(1.7, abs=0.02)


def test_records_shorter_than_a_chunk_are_learned_from() -> None:
    both = records_of(case(filtered, lengths=(100, 40)), 1.7)
    u, y = both.u.copy(), both.y.copy()
    u[0], y[0] = 0.0, 0.0
    method = Adam(300, 0.05, weight_decay=0.0, truncation=60)
    start = {"w": np.zeros(1, np.float32)}
    found = train_adam(Gain(), start, replace(both, u=u, y=y), None, method, 0, silent)
    assert found["w"] == pytest.approx(1.7, abs=0.02)


def test_samples_without_weight_do_not_count() -> None:
    data = case(filtered, lengths=(100, 60))
    clean = records_of(data, 1.0)
    y = clean.y.copy()
    y[0, 20:60] = 1e3
    weight = clean.weight.copy()
    weight[0, 20:60] = 0.0
    method = Adam(20, 0.05)
    start = {"w": np.zeros(1, np.float32)}
    found = [
        train_adam(Gain(), start, replace(clean, y=values, weight=weight), None, method, 0, silent)
        for values in (clean.y, y)
    ]
    assert found[0]["w"] == found[1]["w"]


def test_held_out_blocks_pick_the_number_of_steps() -> None:
    data = case(filtered, lengths=(100,))
    fitted = records_of(data, 1.0)
    # The held-out samples want half the gain: passed on the way up, so fewer steps are best.
    held_out = replace(fitted, y=0.5 * fitted.y, weight=0.01 * fitted.weight)
    method = Adam(100, 0.02, weight_decay=0.0, schedule="constant")
    start = {"w": np.zeros(1, np.float32)}
    found = train_adam(Gain(), start, fitted, held_out, method, 0, silent)
    whole = train_adam(Gain(), start, fitted, None, method, 0, silent)
    assert found["w"] == pytest.approx(0.5, abs=0.1)
    assert whole["w"] == pytest.approx(1.0, abs=0.1)


def test_few_steps_are_picked_among_those_that_were_tried() -> None:
    data = case(filtered, lengths=(100,))
    fitted = records_of(data, 1.0)
    held_out = replace(fitted, y=0.5 * fitted.y, weight=0.01 * fitted.weight)
    method = Adam(10, 0.1, weight_decay=0.0, schedule="constant")
    start = {"w": np.zeros(1, np.float32)}
    reported: list[float] = []

    def log(step: float, loss: float) -> None:
        del loss
        reported.append(step)

    found = train_adam(Gain(), start, fitted, held_out, method, 0, log)
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
    broken = replace(clean, y=np.full_like(clean.y, np.inf))
    start = {"w": np.full(1, 0.25, np.float32)}
    found = train_adam(Gain(), start, broken, None, Adam(5), 0, silent)
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
        trained = ltc.train(model, data.training, data.context, Adam(steps=2))
        assert all(v.dtype == np.float32 for v in jax.tree.leaves(trained.params))
