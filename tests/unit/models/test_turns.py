"""Symmetries of signals: models have them exactly, and fits see the records under each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import neural_ss, recurrent
from asia.models._least_squares import LevenbergMarquardt
from asia.models._networks.training import HoldoutSplit, _split
from asia.models._numerics.symmetry import SignalTransformations, TransformedRecords
from asia.models._numerics.training_records import batch
from asia.models.methods import LBFGS, Adam

ARMS = {"u1": "u2", "u2": "u1", "y1": "y2", "y2": "y1"}
ODD = {"u1": "-u1", "u2": "-u2", "y1": "-y1", "y2": "-y2"}
SMALL = recurrent.Config(cell="rnn", hidden=3, encoder=3)
PAST = 3


def arms(length: int, seed: int, offset: float = 0.0) -> Trajectory:
    """Two alike arms, each bent the same way up and down."""
    rng = np.random.default_rng(seed)
    u = offset + np.repeat(rng.normal(size=(length // 5, 2)), 5, axis=0)
    y = np.zeros((length, 2))
    for k in range(1, length):
        y[k] = 0.8 * y[k - 1] + 0.3 * np.tanh(u[k - 1]) + 0.05 * y[k - 1, ::-1]
    return Trajectory(u, y, 0.1, f"run{seed}")


def context(**symmetry: dict[str, str]) -> Context:
    signals = tuple(tuple(Signal(f"{side}{i}") for i in (1, 2)) for side in "uy")
    return Context(*signals, 0.1, PAST, PAST, symmetry=symmetry)


def simulated(model: Any, u: Array, y: Array) -> Array:
    return model.simulate(u[None, :PAST], y[None, :PAST], u[None, PAST:])[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "config", "method"),
    [
        (
            recurrent,
            replace(SMALL, features=("square",)),
            Adam(steps=4, truncation=20, members=2, holdout=0.2, symmetry=True),
        ),
        (recurrent, SMALL, LBFGS(steps=3, symmetry=True)),
        (
            neural_ss,
            neural_ss.Config(order=2, hidden=2, symmetry=True),
            LevenbergMarquardt(iterations=3),
        ),
        (neural_ss, neural_ss.Config(order=2, hidden=2), Adam(steps=4, symmetry=True)),
    ],
)
def test_a_fitted_model_has_the_symmetries(family: Any, config: Any, method: Any) -> None:
    known, records = context(arms=ARMS, odd=ODD), [arms(60, 0, 0.5), arms(80, 1, 0.5)]
    model = family.train(family.build(config, known), records, known, method)
    t = arms(60, 2)
    y = simulated(model, t.u, t.y)
    scale = np.abs(y).max()
    np.testing.assert_allclose(simulated(model, -t.u, -t.y), -y, atol=1e-5 * scale)
    swapped = simulated(model, t.u[:, ::-1], t.y[:, ::-1])
    np.testing.assert_allclose(swapped, y[:, ::-1], atol=1e-5 * scale)


def test_without_the_setting_it_has_none() -> None:
    known, t = context(arms=ARMS, odd=ODD), arms(60, 2)
    model = recurrent.train(recurrent.build(SMALL, known), [arms(60, 0, 0.5)], known, Adam(steps=4))
    away = simulated(model, -t.u, -t.y) + simulated(model, t.u, t.y)
    assert np.abs(away).max() > 1e-2


@pytest.mark.long
def test_what_was_never_seen_is_learned_from_its_mirror_image() -> None:
    """Records with positive inputs alone, a simulation with negative ones."""
    known, records = context(odd=ODD), [arms(200, seed, 2.0) for seed in (0, 1)]
    config = neural_ss.Config(order=2, hidden=3)
    unseen, errors = arms(200, 5, -2.0), list[float]()
    for symmetry in (False, True):
        model = neural_ss.train(
            neural_ss.build(replace(config, symmetry=symmetry), known), records, known,
            LevenbergMarquardt(iterations=10, starts=1),
        )  # fmt: skip
        y = simulated(model, unseen.u, unseen.y)
        errors.append(float(np.sqrt(((y - unseen.y[PAST:]) ** 2).mean())))
    assert errors[1] < 0.2 * errors[0]


def test_turned_copies_are_held_out_with_their_records() -> None:
    known = context(arms=ARMS)
    data = TransformedRecords.of(
        [arms(40 + 5 * i, i) for i in range(5)], SignalTransformations.of(known)
    )
    found = _split(data.every, known, 0.4, data.copies)
    assert isinstance(found, HoldoutSplit)
    assert sorted(found.held_out.lengths + found.fitted.lengths) == sorted(found.full.lengths)
    assert not {*found.held_out.lengths} & {*found.fitted.lengths}
    assert len(found.held_out.lengths) == 4


def test_turning_goes_with_z_scores() -> None:
    known = context(arms=ARMS, odd=ODD)
    turns, records = SignalTransformations.of(known), [arms(40, 0, 0.7)]
    data = TransformedRecords.of(records, turns)
    physical = [data.scaling.outputs(t.y) for t in turns.turned(records)]
    for z, expected in zip(data.every, physical, strict=True):
        np.testing.assert_allclose(z.y, expected, atol=1e-12)
    assert batch(data.every, known).y.shape[0] == len(turns) == 4


def test_symmetries_of_other_names_are_not_those_of_signals() -> None:
    known = context(odd=ODD, turn={"y1": "y2", "y2": "-y1", "torque": "-torque"})
    assert len(SignalTransformations.of(known)) == 2
    with pytest.raises(UserError, match=r"no \[symmetry\] of the problem"):
        recurrent.train(
            recurrent.build(SMALL, context()), [arms(60, 0)], context(), Adam(symmetry=True)
        )
