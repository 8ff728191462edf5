"""Elementwise functions of the physical inputs, offered to a network beside the inputs themselves.

A thrust goes with the square of a motor speed: a network that is given the square need not learn
it. The functions act on the input in physical units, because a z-score has lost where zero is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._data.scaling import Scaling
from asia.models._networks.network import NetworkModel


def _signed_root(u: Any) -> Any:
    # The slope of the square root has no bound at zero, where an input often rests.
    return u / (jnp.sqrt(jnp.abs(u) + 1e-3))


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "square": lambda u: u * u,
    "cube": lambda u: u * u * u,
    "abs": jnp.abs,
    "sqrt": _signed_root,
}


def check_features(names: Sequence[str], where: str) -> None:
    """Raises UserError for an unknown function; `where` names the configuration."""
    for name in names:
        if name not in FUNCTIONS:
            known = ", ".join(FUNCTIONS)
            raise UserError(f"{where}: feature '{name}' is unknown, expected some of {known}")


def drive_size(names: Sequence[str], nu: int) -> int:
    """Channels a cell with these features is driven by."""
    return nu * (1 + len(names))


@dataclass(frozen=True)
class Features:
    """What turns z-scored inputs into those inputs and standardised functions of the physical
    ones, each input in units of its own root mean square.

    offset, gain (nu): from a z-score to those units; centre, spread (functions * nu): mean and
    standard deviation of the functions over the training data. Hashable, so that a cell may hold
    it; before `fitted` only one without functions can be called.
    """

    names: tuple[str, ...] = ()
    offset: tuple[float, ...] = ()
    gain: tuple[float, ...] = ()
    centre: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()

    def fitted(self, trajectories: Sequence[Trajectory]) -> Features:
        """The same functions, standardised on these records."""
        if not self.names:
            return self
        scaling = Scaling.of(trajectories)
        u = np.concatenate([t.u for t in trajectories])
        size = np.sqrt((u**2).mean(axis=0))
        size = np.where(size > 0, size, 1.0)
        with jax.enable_x64(False):
            raw = np.asarray(_applied(self.names, jnp.asarray(u / size, jnp.float32)), np.float64)
        spread = raw.std(axis=0)
        spread = np.where(spread > 1e-6, spread, 1.0)
        return Features(
            self.names,
            _floats(scaling.u_mean / size),
            _floats(scaling.u_std / size),
            _floats(raw.mean(axis=0)),
            _floats(spread),
        )

    def __call__(self, u: jax.Array) -> jax.Array:
        """(..., nu) z-scores -> (..., nu * (1 + functions))."""
        if not self.names:
            return u
        raw = _applied(self.names, u * jnp.asarray(self.gain) + jnp.asarray(self.offset))
        extra = (raw - jnp.asarray(self.centre)) / jnp.asarray(self.spread)
        return jnp.concatenate([u, extra], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Driven:
    """A structure that reads its inputs through `drive`."""

    drive: Features = Features()


def with_drive(model: NetworkModel, trajectories: Sequence[Trajectory]) -> NetworkModel:
    """The model with the functions of its inputs standardised on these records."""
    cell = model.cell
    if not isinstance(cell, Driven):
        return model
    return replace(model, cell=replace(cell, drive=cell.drive.fitted(trajectories)))


def _applied(names: Sequence[str], u: jax.Array) -> jax.Array:
    return jnp.concatenate([FUNCTIONS[name](u) for name in names], axis=-1)


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
