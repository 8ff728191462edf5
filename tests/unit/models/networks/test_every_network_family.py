"""Common tests of the neural families of this table: windows, long simulations, restarts."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import (
    autoregressive,
    cascaded_ltc,
    cnn,
    koopman,
    ltc,
    recurrent,
    subnet,
    transformer,
)
from asia.models._networks import compiled as compiled_module
from asia.models._networks.compiled import compiled
from asia.models._networks.network import features_of, is_compiled
from asia.models._networks.structure import Restartable, rollout, trace
from asia.models.methods import Adam

FAMILIES: list[tuple[ModuleType, dict[str, Any]]] = [
    (ltc, {"hidden": 3}),
    (recurrent, {"hidden": 3, "encoder": 4}),
    (cascaded_ltc, {"slow": 3, "fast": 3, "width": 4}),
    (autoregressive, {"hidden": 4, "encoder": 4}),
    (koopman, {"levels": 2, "states": 3, "lift": 2, "width": 4}),
    (cnn, {"receptive_field": 5, "width": 4, "memory": 3, "encoder": 4}),
    (transformer, {"layers": 1, "heads": 2, "width": 4, "inner": 4, "span": 8, "encoder": 4}),
    (subnet, {"states": 3, "width": 4, "start": "random"}),
]
every_family = pytest.mark.parametrize(
    ("family", "small"), FAMILIES, ids=lambda v: v.__name__ if isinstance(v, ModuleType) else ""
)


def vehicle(length: int = 120) -> Trajectory:
    """Three outputs driven by the squares of two inputs, one of them an integral."""
    rng = np.random.default_rng(0)
    u = 100 + 20 * np.repeat(rng.standard_normal((length // 5, 2)), 5, axis=0)
    force = (u / 100) ** 2 - 1
    y = np.stack([force[:, 0], force[:, 1], 0.1 * np.cumsum(force[:, 0])], axis=1)
    return Trajectory(u, y, 0.01)


def windows_context(seed: int = 0) -> Context:
    """Windows of 20 samples, each from one measured output."""
    inputs, outputs = (Signal("a"), Signal("b")), (Signal("p"), Signal("q"), Signal("r"))
    return Context(inputs, outputs, 0.01, n_past_u=0, n_past_y=1, horizon=20, seed=seed)


@every_family
@pytest.mark.long
def test_windows_of_a_horizon_and_a_long_simulation(
    family: ModuleType, small: dict[str, Any]
) -> None:
    context, record = windows_context(), vehicle()
    model = family.build(family.Config(**small, features=("square",)), context)
    with pytest.raises(UserError, match="not trained"):
        model.simulate(np.zeros((1, 0, 2)), record.y[None, :1], record.u[None, 1:])
    model = family.train(model, [record], context, Adam(steps=3, truncation=20))
    # Far longer than the windows it was trained on, with inputs inside their range.
    u = np.random.default_rng(1).uniform(60, 140, (2, 5000, 2))
    u[1] = u[0]
    y = model.simulate(np.zeros((2, 0, 2)), np.stack([record.y[:1], record.y[50:51]]), u)
    assert y.shape == (2, 5000, 3)
    assert np.isfinite(y).all()
    assert np.abs(y[0, :20] - y[1, :20]).max() > 0


@every_family
def test_parameters_come_from_the_seed_alone(family: ModuleType, small: dict[str, Any]) -> None:
    context = windows_context(seed=4)
    model = family.build(family.Config(**small), context)
    assert hash(model.cell) == hash(family.build(family.Config(**small), context).cell)
    assert isinstance(model.cell, Restartable)
    again = model.cell.parameters(context)
    other = model.cell.parameters(replace(context, seed=5))
    assert _flat(again) == _flat(model.params) != _flat(other)


@every_family
def test_no_size_may_be_zero(family: ModuleType, small: dict[str, Any]) -> None:
    for name, value in small.items():
        if isinstance(value, int):
            with pytest.raises(UserError, match="at least"):
                family.Config(**{name: 0})


@every_family
def test_windows_are_simulated_apart_however_many_there_are(
    family: ModuleType, small: dict[str, Any]
) -> None:
    model = family.build(family.Config(**small), windows_context())
    rng = np.random.default_rng(2)
    window, u = (
        rng.standard_normal(shape).astype(np.float32) for shape in ((300, 3), (300, 15, 2))
    )
    together = features_of(model.cell, model.params, window, u)
    assert together.shape[:2] == (300, 15)
    for row in (0, 140, 299):
        alone = features_of(model.cell, model.params, window[row, None], u[row, None])
        np.testing.assert_allclose(together[row], alone[0], rtol=1e-5, atol=1e-6)
    assert features_of(model.cell, model.params, window[:0], u[:0]).shape == together[:0].shape


def test_records_of_very_many_samples_are_left_to_jax() -> None:
    assert not is_compiled(1, 100_000)
    assert not is_compiled(100_000, 100)
    assert is_compiled(1, 1_000_000)
    assert is_compiled(10_000, 10_000)


def test_a_compiled_simulation_goes_on_from_block_to_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = recurrent.build(recurrent.Config(hidden=3), windows_context())
    rng = np.random.default_rng(3)
    window, u = (rng.standard_normal(shape).astype(np.float32) for shape in ((2, 3), (2, 70, 2)))
    for simulate in (rollout, trace):
        whole = compiled(simulate, model.cell, model.params, window, u)
        with monkeypatch.context() as patched:
            patched.setattr(compiled_module, "_BLOCK", 32)
            blocks = compiled(simulate, model.cell, model.params, window, u)
        np.testing.assert_allclose(blocks, whole, atol=1e-6)


def _flat(tree: Any) -> bytes:
    if isinstance(tree, dict):
        return b"".join(_flat(tree[key]) for key in sorted(tree))
    if isinstance(tree, (list, tuple)):
        return b"".join(_flat(value) for value in tree)
    assert tree.dtype == np.float32
    return tree.tobytes()
