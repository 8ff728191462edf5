"""Fits that begin with pieces of the records, and states fitted to the past window."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.errors import UserError
from asia.models import neural_ss, nl_lfr
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.system import LinearSystem
from asia.models._state_space.model import PastFit, fitted_state
from asia.models._state_space.structure import StateSpaceStructure
from asia.models.methods import Adam
from tests.unit.models.systems.equations import context_for, duffing_record

CONFIG = neural_ss.Config(order=2, channels=1, basis="polynomial")
STRUCTURE = StateSpaceStructure(2, 1, 1, "state", "tanh", 3, 3, None)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), known=st.booleans())
def test_a_state_is_fitted_where_the_window_says_more_than_the_map(seed: int, known: bool) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.3, 1.0)
    a = 0.95 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    system = LinearSystem(a, rng.normal(size=(2, 1)), np.array([[1.0, 0.0]]), np.zeros((1, 1)),
                          np.zeros(1))  # fmt: skip
    params = STRUCTURE.start(system, rng)
    x, u = rng.normal(size=(4, 2)), rng.normal(size=(4, 9, 1))
    states, y = STRUCTURE.simulate(params, x, u)
    how = PastFit(8, np.full(2, 1e-7 if known else 1.0), np.full(1, 1.0 if known else 1e-4))
    guess = x + 0.3 * rng.normal(size=x.shape)
    found = fitted_state(STRUCTURE, params, how, guess, u, y[:, :-1])
    expected = STRUCTURE.simulate(params, guess, u)[0] if known else states
    assert found == pytest.approx(expected[:, -1], abs=1e-3)


def test_a_window_that_diverges_keeps_the_guess() -> None:
    rng = np.random.default_rng(0)
    system = LinearSystem(np.array([[1e200]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)),
                          np.zeros(1))  # fmt: skip
    structure = replace(STRUCTURE, order=1)
    params = structure.start(system, rng)
    how = PastFit(3, np.ones(1), np.ones(1))
    found = fitted_state(
        structure, params, how, np.ones((1, 1)), np.ones((1, 4, 1)), np.ones((1, 3, 1))
    )
    assert found.shape == (1, 1)


@pytest.mark.parametrize("option", ["pieces", "past_fit"])
def test_adam_has_no_use_for_them(option: str) -> None:
    context = context_for(None, "u", "y", 0.15)
    model = neural_ss.build(replace(CONFIG, **{option: True}), context)
    with pytest.raises(UserError, match=f"neural_ss.Config: {option}"):
        neural_ss.train(model, [duffing_record(60, 0)], context, Adam(steps=1))


def error(config: neural_ss.Config, seed: int) -> tuple[float, float]:
    record = duffing_record(500, seed, noise=0.01)
    context = context_for(None, "u", "y", 0.15, seed=1)
    method = LevenbergMarquardt(iterations=40, starts=1)
    model = neural_ss.train(neural_ss.build(config, context), [record[:300]], context, method)
    found = []
    for part in (record[:300], record[300:]):
        y = model.simulate(part.u[None, :5], part.y[None, :5], part.u[None, 5:])[0]
        found.append(float(np.std(y - part.y[5:])) / 0.01)
    return found[0], found[1]


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 4])
def test_the_model_itself_says_better_where_a_window_ends(seed: int) -> None:
    """Seed 0 is one where the pieces alone mislead."""
    _, plain = error(CONFIG, seed)
    _, fitted = error(replace(CONFIG, pieces=True, past_fit=True), seed)
    assert plain > 1.3
    assert fitted - 1.0 < 0.6 * (plain - 1.0)


@pytest.mark.parametrize(
    ("family", "config"),
    [
        (neural_ss, replace(CONFIG, pieces=True, integrators=1)),
        (nl_lfr, nl_lfr.Config(order=2, hidden=3, pieces=True, integrators=1)),
    ],
)
@pytest.mark.parametrize("samples", [25, 70])
def test_pieces_of_short_records(family: Any, config: Any, samples: int) -> None:
    context = context_for(None, "u", "y", 0.15, seed=1)
    records = [duffing_record(samples, seed) for seed in (0, 1)]
    model = family.train(family.build(config, context), records, context, LevenbergMarquardt(2))
    y = model.simulate(records[0].u[None, :5], records[0].y[None, :5], records[0].u[None, 5:])
    assert np.isfinite(y).all()


@pytest.mark.long
def test_a_delay_that_only_the_linear_model_sees_is_not_kept() -> None:
    record = duffing_record(200, 7, noise=0.01)
    context = context_for(None, "u", "y", 0.15, seed=1)
    late = replace(CONFIG, delay=3)
    found = {}
    for config in (late, replace(CONFIG, delay=None, pieces=True)):
        method = LevenbergMarquardt(iterations=30, starts=1)
        model = neural_ss.train(neural_ss.build(config, context), [record], context, method)
        assert model.fitted is not None
        found[config.delay] = model.fitted.delay
    assert found == {3: 3, None: 0}


@pytest.mark.parametrize(("channels", "vary"), [(None, False), (1, True)])
def test_polynomials_of_all_states_have_one_start(channels: int | None, vary: bool) -> None:
    structure = replace(STRUCTURE, basis="polynomial", channels=channels)
    assert structure.starts_vary == vary


@pytest.mark.long
def test_polynomials_from_short_pieces_follow_a_strongly_bent_spring() -> None:
    _, layer = error(replace(CONFIG, channels=None, basis="tanh", hidden=8), 4)
    _, short = error(replace(CONFIG, channels=None, pieces=True, past_fit=True), 4)
    assert short < 1.5 < layer
