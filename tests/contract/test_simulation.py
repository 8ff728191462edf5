"""Every model family simulates in NumPy what JAX simulates, and without importing JAX."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np
import pytest

from asia.agents import Facts
from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models._networks import compiled, network
from asia.models._networks.network import Driven, NetworkModel, as_built
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import flat_past, scaled
from asia.problem import ParameterRange, Physics

FLOAT32, FLOAT64 = 1e-5, 1e-9
PAST, WINDOWS, HORIZON, LONG = 5, 30, 12, 800
# A simulator of the user's own has no steps.
ROWS = tuple(row for row in all_families() if "plant" not in row.needs)
NETWORKS = [row for row in ROWS if row.seeds]


def named(rows: list[Family] | tuple[Family, ...], *marks: pytest.MarkDecorator) -> Any:
    return pytest.mark.parametrize("row", [pytest.param(r, id=r.name, marks=marks) for r in rows])


def cart(samples: int = 200) -> Trajectory:
    """Position and speed of a cart that two forces push."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((samples // 5, 2)), 5, axis=0)
    x = np.zeros((samples, 2))
    for k in range(samples - 1):
        speed = x[k, 1]
        force = u[k, 0] + 0.5 * np.tanh(u[k, 1]) - speed - 0.2 * x[k, 0]
        x[k + 1] = x[k] + 0.1 * np.array([speed, force])
    return Trajectory(u, x + 1e-3 * rng.standard_normal(x.shape), 0.1, "cart")


def cart_context() -> Context:
    physics = Physics(
        states=("position", "speed"),
        dynamics={"position": "speed", "speed": "push + k1*pull - k2*speed - k3*position"},
        parameters={name: ParameterRange(0.01, 5.0) for name in ("k1", "k2", "k3")},
    )
    inputs, outputs = (Signal("push"), Signal("pull")), (Signal("position"), Signal("speed"))
    return Context(inputs, outputs, 0.1, PAST, PAST, physics=physics, seed=1)


def executed(row: Family, **config: Any) -> ModuleType:
    """The candidate that the family is tested with."""
    c = cart_context()
    facts = Facts(**c.known(), records=(cart(),))
    module = ModuleType(row.name)
    exec(row.smallest(facts).configured(**config).source(row.label), module.__dict__)
    return module


def shaken(row: Family) -> NetworkModel:
    """The network with random parameters, its equations and its scaling from the records."""
    records, context = [cart()], cart_context()
    model: NetworkModel = executed(row, features=("square", "sqrt")).build_model(context)
    cell, scaling = model.cell, Scaling.of(records)
    assert isinstance(cell, Driven)
    prepare = cell.start(records, context) or as_built
    params = prepare(model.params, scaled(records, scaling), scaling)
    rng = np.random.default_rng(2)
    drawn = mapped(params, lambda v: (v + 0.1 * rng.standard_normal(v.shape)).astype(np.float32))
    if "fixed" in params:
        drawn["fixed"] = params["fixed"]
    cell = replace(cell, drive=cell.drive.fitted(records))
    return replace(model, cell=cell, params=drawn, scaling=scaling)


def mapped(tree: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(tree, dict):
        return {name: mapped(branch, change) for name, branch in tree.items()}
    if isinstance(tree, list):
        return [mapped(branch, change) for branch in tree]
    return change(tree)


@cache
def trained(row: Family) -> Any:
    return executed(row).fit([cart()], cart_context())


def requests() -> list[tuple[Array, Array, Array]]:
    """Many short windows, and one long record with inputs inside their range."""
    record, rng = cart(), np.random.default_rng(3)
    starts = rng.integers(PAST, len(record) - HORIZON, WINDOWS)
    past, future = starts[:, None] + np.arange(-PAST, 0), starts[:, None] + np.arange(HORIZON)
    long = rng.uniform(-1, 1, (1, LONG, 2))
    return [
        (record.u[past], record.y[past], record.u[future]),
        (record.u[None, :PAST], record.y[None, :PAST], long),
    ]


class Spy:
    """Simulates in JAX, and keeps the precision."""

    def __init__(self) -> None:
        self.precisions: list[Any] = []
        self._compiled = compiled.compiled

    def __call__(self, simulate: Any, cell: Any, params: Any, window: Any, u: Any) -> Any:
        found = self._compiled(simulate, cell, params, window, u)
        self.precisions.append(found.dtype)
        return found


@pytest.fixture
def spy(monkeypatch: pytest.MonkeyPatch) -> Spy:
    found = Spy()
    monkeypatch.setattr(compiled, "compiled", found)
    return found


Ask = Callable[[Array, Array, Array], Array]
Pairs = list[tuple[Array, Array]]


def in_numpy_and_jax(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> Pairs:
    """Answers to every request."""
    pairs: Pairs = []
    for request in requests():
        monkeypatch.setattr(network, "is_compiled", lambda *shape: False)
        in_numpy = ask(*request)
        monkeypatch.setattr(network, "is_compiled", lambda *shape: True)
        pairs.append((in_numpy, ask(*request)))
    return pairs


def largest_difference(pairs: Pairs) -> float:
    """Return the largest difference relative to the size of the output."""
    found = 0.0
    for in_numpy, in_jax in pairs:
        assert in_numpy.dtype == in_jax.dtype
        assert np.isfinite(in_numpy).all()
        size = np.abs(in_jax).max(axis=(0, 1))
        assert (size > 0).all()
        found = max(found, float((np.abs(in_numpy - in_jax).max(axis=(0, 1)) / size).max()))
    return found


@pytest.mark.long
@named(NETWORKS)
def test_a_network_simulates_in_numpy_as_in_jax(
    row: Family, spy: Spy, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = shaken(row)
    assert largest_difference(in_numpy_and_jax(model.simulate, monkeypatch)) < FLOAT32
    assert spy.precisions == [np.float32, np.float32]
    monkeypatch.undo()
    past_u, past_y, u = (np.asarray(values, np.float32) for values in requests()[0])
    found = network.outputs_of(model.cell, model.params, flat_past(past_u, past_y), u)
    assert found.dtype == np.float32


@pytest.mark.slow
@named(NETWORKS)
def test_a_network_simulates_in_double_precision_as_in_jax(
    row: Family, spy: Spy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Double precision, where no rounding can hide that two formulas differ."""
    model = shaken(row)
    params = mapped(model.params, np.float64)

    def ask(past_u: Array, past_y: Array, u: Array) -> Array:
        return network.outputs_of(model.cell, params, flat_past(past_u, past_y), u)

    assert largest_difference(in_numpy_and_jax(ask, monkeypatch)) < FLOAT64
    assert spy.precisions == [np.float64, np.float64]


@pytest.mark.long
@named(ROWS)
def test_a_trained_model_simulates_in_numpy_as_in_jax(
    row: Family, spy: Spy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Families without a step of this kind never ask JAX, and answer the same twice."""
    model = trained(row)
    found = largest_difference(in_numpy_and_jax(model.simulate, monkeypatch))
    precision = set(spy.precisions)
    assert len(precision) <= 1
    assert found < (FLOAT32 if precision == {np.dtype(np.float32)} else FLOAT64)
    if row.seeds:
        assert precision


_LOADING = """
import pickle, sys
from pathlib import Path

for path in sorted(Path(sys.argv[1]).glob("*.model")):
    model, requests = pickle.loads(path.read_bytes())
    answers = [model.simulate(*request) for request in requests]
    path.with_suffix(".answers").write_bytes(pickle.dumps(answers))
    assert "jax" not in sys.modules, f"{path.stem} imports JAX"
"""


def answered_elsewhere(models: dict[str, Any], folder: Path) -> None:
    """Simulate in a fresh process, which loads all models and must not import JAX."""
    for name, model in models.items():
        (folder / f"{name}.model").write_bytes(cloudpickle.dumps((model, requests())))
    command = [sys.executable, "-W", "error", "-c", _LOADING, str(folder)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert found.returncode == 0, found.stderr
    for name, model in models.items():
        answers = pickle.loads((folder / f"{name}.answers").read_bytes())
        for request, answer in zip(requests(), answers, strict=True):
            np.testing.assert_array_equal(answer, model.simulate(*request), name)


@pytest.mark.long
def test_trained_models_are_loaded_and_simulated_without_jax(tmp_path: Path) -> None:
    answered_elsewhere({row.name: trained(row) for row in ROWS}, tmp_path)


@pytest.mark.slow
def test_models_are_built_without_jax() -> None:
    """Build models without JAX, as the process that checks a source and the one that opens a
    run."""
    lines = [f"import {row.package}.{row.name}" for row in ROWS]
    script = "\n".join(["import sys", *lines, "assert 'jax' not in sys.modules"])
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
