"""The step of every family with equations gives in NumPy what it gives in JAX."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal
from asia.models import greybox, hybrid, physics_net
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.measured import MeasuredCell
from asia.models._equations.simulate import Scales, simulate
from asia.models._networks.compiled import compiled
from asia.models._networks.network import outputs_of
from asia.models._networks.structure import rollout
from asia.problem import Bounds, ParameterRange, Physics
from tests.unit.models.systems.memory import remembering

FLOAT32, FLOAT64 = 1e-5, 1e-9
ROWS, SEGMENTS, SAMPLES = 3, 4, 60
# Every function of the expressions' table, constants, definitions, bounds and whole powers.
PHYSICS = Physics(
    states=("level", "speed"),
    parameters={"k": ParameterRange(0.1, 2.0), "c": ParameterRange(-1.0, 1.0)},
    constants={"g": 9.81},
    definitions={
        "flow": "k*sqrt(level) + softplus(c*speed)/g",
        "bend": "sin(speed) - cos(level)*tanh(pump) + min(speed, pump, 0.3) + abs(tilt)",
        "drag": "clip(speed, -0.5, 0.5)*abs(speed) + max(-1, -speed) + arctan2(speed, 2)",
    },
    dynamics={
        "level": "pump - flow + 0.1*log(1 + level**2) - 0.2*exp(-level) - tan(0.1*tilt)/g",
        "speed": "c*bend - drag - speed**3 + sigmoid(tilt) - 0.1*sign(tilt)*arctan(speed)"
        " + arcsin(tanh(speed)) - arccos(0.5*tanh(level)) + 0.01*(sinh(tilt) - cosh(tilt))",
    },
    observation={"height": "level", "current": "speed*g + flow"},
    bounds={"level": Bounds(min=0.0)},
)
CONTEXT = Context(
    inputs=(Signal("pump"), Signal("tilt")),
    outputs=(Signal("height"), Signal("current")),
    sampling_time=0.1,
    n_past_u=3,
    n_past_y=3,
    physics=PHYSICS,
)
EVERYTHING: dict[str, Any] = {
    "saturation": ("level",),
    "spill": True,
    "linear": True,
    "offset": ("speed", "current"),
    "input_delay": 2.5,
}
CONFIGS = {
    "equations": {},
    "limits": {"saturation": ("level", "speed"), "spill": True, "substeps": 1},
    "linear": {"linear": True, "offset": ("level", "height")},
    "delay": {"input_delay": 2.5, "robust": 0.3},
    "network": {"residual": 3},
    "everything": {**EVERYTHING, "residual": 2, "substeps": 3},
}


def agrees(in_numpy: Any, in_jax: Any, tolerance: float) -> None:
    """Compare relative to the size of each channel, (T, n, ...)."""
    assert isinstance(in_numpy, np.ndarray)
    assert not isinstance(in_jax, np.ndarray)
    assert in_numpy.dtype == in_jax.dtype
    axes = (0, *range(2, in_numpy.ndim))
    size = np.abs(in_numpy).max(axis=axes)
    assert (size > 1e-3).all()
    assert (np.abs(in_numpy - np.asarray(in_jax)).max(axis=axes) / size).max() < tolerance


def drawn(structure: GreyBoxStructure) -> tuple[Scales, np.ndarray, np.ndarray, np.ndarray]:
    """Scales, coordinates, initial states and inputs of several rows and segments."""
    rng = np.random.default_rng(0)
    nx, nu, ny, units = structure.nx, structure.nu, structure.ny, structure.config.residual
    sizes = [rng.uniform(0.5, 1.5, (n, ROWS)) for n in (nx, nx, nx, nx, nu, nu, ny)]
    sizes[2] = sizes[0] + 0.3
    low, high = np.full((nx, ROWS), -50.0), np.full((nx, ROWS), 50.0)
    hidden = rng.normal(size=(units, structure.nx_own + nu + 1, ROWS))
    scales = Scales(*sizes, low, high, hidden)
    z = 0.5 * rng.normal(size=(structure.layout.size, ROWS))
    x0 = rng.uniform(0.2, 1.0, (nx, ROWS, SEGMENTS))
    return scales, z, x0, np.repeat(rng.normal(size=(SAMPLES // 4, nu, SEGMENTS)), 4, axis=0)


def both_ways(structure: GreyBoxStructure) -> None:
    arguments = drawn(structure)
    found = simulate(structure, *arguments)
    with jax.enable_x64(True):
        run = jax.jit(lambda *a: simulate(structure, *a))
        for in_numpy, in_jax in zip(found, run(*arguments), strict=True):
            agrees(in_numpy, in_jax, FLOAT64)


@pytest.mark.parametrize("name", CONFIGS)
def test_a_grey_box_steps_in_numpy_as_in_jax(name: str) -> None:
    both_ways(greybox.build(greybox.Config(**CONFIGS[name]), CONTEXT).structure)


def test_memory_steps_in_numpy_as_in_jax() -> None:
    both_ways(remembering().structure)


def test_a_hybrid_steps_in_numpy_as_in_jax() -> None:
    config = hybrid.Config(base=greybox.Config(**EVERYTHING), units=2)
    both_ways(hybrid.build(config, CONTEXT).structure)


def test_measured_windows_step_in_numpy_as_in_jax() -> None:
    physics = replace(PHYSICS, observation={"height": "level", "current": "speed"})
    context = replace(CONTEXT, physics=physics, horizon=10)
    structure = greybox.build(greybox.Config(linear=True), context).structure
    assert structure.states_measured
    both_ways(structure)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "past_inputs", "precision", "tolerance"),
    [
        (physics_net.Config(), 0, "float32", FLOAT32),
        (physics_net.Config(linear=True, lag=False, gain=False), 2, "float64", FLOAT64),
        (physics_net.Config(linear=True, disturbance=True, network="mlp", hidden=4), 0, "float64",
         FLOAT64),
        (physics_net.Config(disturbance=True, network="gru", hidden=4, layers=2), 2, "float64",
         FLOAT64),
        (physics_net.Config(network="lstm", hidden=4), 2, "float32", FLOAT32),
    ],
)  # fmt: skip
def test_measured_states_step_in_numpy_as_in_jax(
    config: physics_net.Config, past_inputs: int, precision: str, tolerance: float
) -> None:
    """The outputs are not in the order of the states, and the kinematics not the first."""
    physics = Physics(
        states=("speed", "place"),
        parameters={"pull": ParameterRange(0.3, 10.0)},
        dynamics={"speed": "pull*force - side*sin(place)", "place": "speed"},
    )
    context = Context(
        inputs=(Signal("force"), Signal("side")),
        outputs=(Signal("place"), Signal("speed")),
        sampling_time=0.05,
        n_past_u=past_inputs,
        n_past_y=1,
        physics=physics,
    )
    model = physics_net.build(config, context).network
    assert isinstance(model.cell, MeasuredCell)
    rng = np.random.default_rng(1)
    fixed = {name: np.zeros(2) for name in ("y_mean", "u_mean")}
    fixed |= {"y_std": np.array([2.0, 0.5]), "u_std": np.array([1.5, 0.7]), "rate": np.ones(1)}
    fixed |= {"x_low": np.full(2, -9.0), "x_high": np.full(2, 9.0)}
    read = len(model.cell.read)
    fixed |= {"s_mean": np.zeros(read), "s_std": np.ones(read)}
    shaken = jax.tree.map(lambda v: v + 0.1 * rng.normal(size=np.shape(v)), dict(model.params))
    params = jax.tree.map(lambda v: np.asarray(v, precision), {**shaken, "fixed": fixed})
    window = rng.normal(size=(SEGMENTS, 2 * past_inputs + 2)).astype(precision)
    u = rng.normal(size=(SEGMENTS, SAMPLES, 2)).astype(precision)
    found = outputs_of(model.cell, params, window, u)
    with jax.enable_x64(precision == "float64"):
        in_jax = jax.numpy.asarray(compiled(rollout, model.cell, params, window, u))
        agrees(found.swapaxes(1, 2).swapaxes(0, 1), in_jax.swapaxes(1, 2).swapaxes(0, 1), tolerance)
