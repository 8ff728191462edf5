"""Equations with every operator that remembers past samples, and a model with numbers of no fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asia.candidate import Context
from asia.data import Signal
from asia.models import greybox
from asia.models._equations.fit import FittedEquations
from asia.models._equations.simulate import Scales, WindowPrior
from asia.problem import ParameterRange, Physics

PHYSICS = Physics(
    states=("x",),
    parameters={
        "a": ParameterRange(0.1, 1.0),
        "volume": ParameterRange(1.0, 6.0),
        "time": ParameterRange(0.5, 4.0),
        "dead": ParameterRange(0.5, 5.0),
        "spread": ParameterRange(0.001, 0.1),
    },
    definitions={
        "hot": "plug_flow(u1, u0, volume)",
        "slow": "lag(delay(u1*u0, dead), time)",
        "inside": "plug_mean(lag(u1, time), u0, volume, spread)",
    },
    dynamics={"x": "a*(hot - x) + 0.1*slow"},
    observation={
        "y0": "delay(x, dead/u0) + 0.2*plug_flow(u1, u0, 2*volume, spread) + 0.3*inside",
        "y1": "plug_mean(u1**2, u0, volume) - plug_flow(x*u1, u0, volume)",
    },
)
CONTEXT = Context(
    inputs=(Signal("u0", "l/s"), Signal("u1", "V")),
    outputs=(Signal("y0", "mm"), Signal("y1", "mm")),
    sampling_time=0.5,
    n_past_u=3,
    n_past_y=3,
    physics=PHYSICS,
)
MEMORY = (12, 9, 18, 2, 16, 15, 14, 12)
"""Buffers shorter than some delays, which a simulation then cuts."""


def remembering(context: Context = CONTEXT) -> greybox.GreyBox:
    """A model of these equations that nobody has fitted."""
    rng = np.random.default_rng(5)
    structure = greybox.build(greybox.Config(), context).structure
    structure = replace(structure, memory=MEMORY)
    nx, nu, ny = structure.nx, structure.nu, structure.ny
    ones = [np.ones(n) for n in (nx, nx, nx, nx, nu, nu, ny)]
    limits = np.full(nx, -1e3), np.full(nx, 1e3)
    scales = Scales(*ones, *limits, np.zeros((0, structure.nx_own + nu + 1)))
    width = 1 + context.n_past_u * nu + context.n_past_y * ny
    mean = 0.1 * rng.standard_normal((nx, width))
    prior = WindowPrior(mean, np.full(nx, 0.5), np.zeros(ny), np.full(ny, 0.3))
    z = 0.4 * rng.standard_normal(structure.layout.size)
    return greybox.GreyBox(structure, FittedEquations(z, scales, prior, np.zeros(1)))


def inputs(samples: int, seed: int = 0) -> np.ndarray:
    """A flow that varies five times, and a signal (samples, 2), in steps of different lengths."""
    rng = np.random.default_rng(seed)
    flow = np.repeat(rng.uniform(0.3, 1.5, samples // 10 + 1), 10)[:samples]
    signal = np.repeat(rng.standard_normal(samples // 7 + 1), 7)[:samples]
    return np.stack([flow, signal], axis=1)
