"""Records of the plants of the catalogue, from equations at the sizes of their examples."""

from __future__ import annotations

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.models import greybox
from asia.models._equations.transport import along_record
from asia.plants.catalogue import Plant

_FINE = 8
"""Integration steps a sample."""


def example_record(
    plant: Plant, samples: int = 120, seed: int = 0, spread: float = 0.0, noise: float = 0.0
) -> Trajectory:
    """Simulate a plant under steps of its inputs.

    Args:
        spread: relative deviation of the parameters from those of the example
        noise: deviation of the noise, relative to each output
    """
    rng = np.random.default_rng(seed)
    entry, physics = plant.entry, plant.example()
    inputs, outputs = example_signals(plant)
    context = Context(inputs, outputs, 1.0, 1, 1, physics=physics)
    structure = greybox.build(greybox.Config(substeps=_FINE), context).structure
    system = structure.equations
    steps = rng.uniform(-1.7, 1.7, (samples // 10 + 1, len(entry.inputs)))
    size = np.array([role.example for role in entry.inputs.values()])
    u = np.repeat(size[:, 0] + size[:, 1] * steps, 10, axis=0)[:samples]
    known = plant.example_parameters()
    p = np.array([known[n] * (1 + spread * rng.uniform(-1, 1)) for n in system.parameters])
    low = [physics.bounds[s].min if s in physics.bounds else None for s in physics.states]
    least = np.array([-np.inf if one is None else one for one in low])
    x = np.array([entry.start.get(s, 0.0) for s in physics.states])
    rates, y = system.rates(np), np.zeros((samples, len(entry.outputs)))
    # Delays of inputs follow the inputs.
    seen = along_record(structure, p[:, None], u[:, :, None, None])[0][..., 0, 0]
    for k in range(samples):
        now = seen[k][:, None]
        y[k] = system.observe(p[:, None], x[:, None], now)[:, 0]
        for _ in range(_FINE):
            one = rates(p[:, None], x[:, None], now)[:, 0]
            middle = np.maximum(x + one / (2 * _FINE), least)
            x = np.maximum(x + rates(p[:, None], middle[:, None], now)[:, 0] / _FINE, least)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    return Trajectory(u, y, 1.0, plant.name)


def example_signals(plant: Plant) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
    """Inputs and outputs, called like the roles."""
    inputs = tuple(Signal(name) for name in plant.entry.inputs)
    return inputs, tuple(Signal(name) for name in plant.entry.outputs)
