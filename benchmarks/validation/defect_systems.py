"""Systems with a defect that a model of them lacks, for defects.py: masses, motors and pendulums.

All are stepped sample by sample with NumPy, many at a time: a last axis holds variants of the
parameters, so that the fits of all folds and seeds of one system run together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Array = np.ndarray
SAMPLES, STEP = 1500, 0.05


@dataclass(frozen=True)
class Motion:
    """Acceleration = -stiffness(x) - damping(v) + gains . u - friction, of one mass."""

    name: str
    truth: tuple[float, ...]
    """Stiffness, damping, one gain an input, then those of `extra`."""
    inputs: int = 1
    output: str = "x"
    spring: Callable[[Array, Array], Array] = lambda x, extra: x
    drag: Callable[[Array], Array] = lambda v: v
    extra: int = 0


SYSTEMS = (
    Motion("motor speed", (0.0, 1.2, 2.0), output="v"),
    Motion("servo", (2.0, 2.4, 2.0)),
    Motion("light spring", (1.0, 0.6, 1.0)),
    Motion("stiff spring", (6.0, 1.5, 5.0)),
    Motion("hard spring", (1.5, 1.0, 2.0, 0.4), spring=lambda x, e: x + e * x**3, extra=1),
    Motion("pendulum", (4.0, 1.6, 2.0), spring=lambda x, e: np.sin(x)),
    Motion("two inputs", (2.0, 1.6, 2.0, -1.2), inputs=2),
    Motion("square drag", (1.5, 1.0, 2.0), drag=lambda v: v * (0.4 + np.abs(v))),
)


@dataclass(frozen=True)
class Defect:
    """Effect that the system has and the model does not."""

    delay: int = 0
    lag: float = 0.0
    friction: float = 0.0
    ceiling: float | None = None
    drift: float = 0.0
    change: float = 0.0
    """Drift of the gain and the damping over the record."""


def excitation(system: Motion, random: np.random.Generator) -> Array:
    """Steps of random height and length, with a little of everything on top (SAMPLES, inputs)."""
    columns = []
    for _ in range(system.inputs):
        u, at = np.zeros(SAMPLES), 0
        while at < SAMPLES:
            length = int(random.integers(5, 50))
            u[at : at + length] = random.uniform(-1.5, 1.5)
            at += length
        columns.append(u + 0.2 * random.standard_normal(SAMPLES))
    return np.stack(columns, axis=1)


def run(system: Motion, theta: Array, u: Array, defect: Defect) -> Array:
    """Position or speed (T, n). theta (p, n); u (T, inputs, n or 1)."""
    stiffness, damping = theta[0], theta[1]
    gains, extra = theta[2 : 2 + system.inputs], theta[2 + system.inputs :]
    bent = extra[0] if system.extra else np.zeros_like(stiffness)
    x, v, f = (np.zeros(theta.shape[1]) for _ in range(3))
    out = np.zeros((len(u), theta.shape[1]))
    forces = np.einsum("tin,in->tn", np.broadcast_to(u, (*u.shape[:2], theta.shape[1])), gains)
    if defect.delay:
        forces = np.concatenate([np.repeat(forces[:1], defect.delay, 0), forces[: -defect.delay]])
    for k in range(len(u)):
        out[k] = x if system.output == "x" else v
        wanted = forces[k]
        f = f + STEP / defect.lag * (wanted - f) if defect.lag else wanted
        rubbing = defect.friction * np.tanh(v / 0.02) if defect.friction else 0.0
        factor = 1.0 + defect.change * k / len(u)
        drag = damping * factor * system.drag(v)
        a = factor * f - stiffness * system.spring(x, bent) - drag - rubbing
        v = np.clip(v + STEP * a, -1e3, 1e3)
        x = np.clip(x + STEP * v, -1e3, 1e3)
    return out


def measured(
    system: Motion, defect: Defect, u: Array, random: np.random.Generator, noise: float
) -> Array:
    """(T,) with noise of this share of the deviation, and what the sensor does."""
    theta = np.array(system.truth)[:, None]
    y = run(system, theta, u[:, :, None], defect)[:, 0]
    size = y.std()
    if defect.ceiling is not None:
        y = np.minimum(y, y.mean() + defect.ceiling * size)
    y = y + defect.drift * size * np.linspace(0.0, 1.0, len(y))
    return y + noise * size * random.standard_normal(len(y))
