"""Elementwise functions of the physical inputs, offered to a network in addition to the inputs.

A thrust goes with the square of a motor speed: a network that is given the square need not learn
it. The functions act on the input in physical units, because a z-score has lost its zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._config import owner
from asia.models._data.scaling import Scaling


def _signed_root(u: AnyArray) -> AnyArray:
    # The slope of the square root has no bound at zero, where an input often rests.
    return u / namespace(u).sqrt(abs(u) + 1e-3)


class NetworkConfig(Protocol):
    """Settings of a family whose network reads functions of the inputs."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of these functions."""
        ...


FUNCTIONS: dict[str, Callable[[AnyArray], AnyArray]] = {
    "square": lambda u: u * u,
    "cube": lambda u: u * u * u,
    "abs": abs,
    "sqrt": _signed_root,
}


def check_features(settings: NetworkConfig) -> None:
    """Check that `settings.features` names known functions.

    Raises:
        UserError: if it does not.
    """
    for name in settings.features:
        if name not in FUNCTIONS:
            known = ", ".join(FUNCTIONS)
            raise UserError(
                f"{owner(settings)}: feature '{name}' is unknown, expected some of {known}"
            )


def drive_size(names: Sequence[str], nu: int) -> int:
    """Number of channels that drive a cell with these features."""
    return nu * (1 + len(names))


@dataclass(frozen=True)
class Features:
    """Map from z-scored inputs to those inputs and standardised functions of the physical ones.

    Each physical input is in units of its own root mean square. Hashable, so that a structure may
    hold
    it; before `fitted` only one without functions can be called.
    """

    names: tuple[str, ...] = ()
    """Functions, of `FUNCTIONS`."""
    offset: tuple[float, ...] = ()
    """Mean of each input in units of its root mean square."""
    gain: tuple[float, ...] = ()
    """Standard deviation of each input in units of its root mean square."""
    centre: tuple[float, ...] = ()
    """Mean over the training data of each function of each input."""
    spread: tuple[float, ...] = ()
    """Standard deviation over the training data of each function of each input."""

    def fitted(self, trajectories: Sequence[Trajectory]) -> Features:
        """Standardise the functions on these records."""
        if not self.names:
            return self
        scaling = Scaling.of(trajectories)
        u = np.concatenate([t.u for t in trajectories])
        size = np.sqrt((u**2).mean(axis=0))
        size = np.where(size > 0, size, 1.0)
        raw = _applied(self.names, u / size)
        spread = raw.std(axis=0)
        spread = np.where(spread > 1e-6, spread, 1.0)
        return Features(
            self.names,
            _floats(scaling.u_mean / size),
            _floats(scaling.u_std / size),
            _floats(raw.mean(axis=0)),
            _floats(spread),
        )

    def __call__(self, u: AnyArray) -> AnyArray:
        """Map (..., nu) z-scores -> (..., nu * (1 + functions))."""
        if not self.names:
            return u
        numbers = (self.gain, self.offset, self.centre, self.spread)
        gain, offset, centre, spread = (np.asarray(v, u.dtype) for v in numbers)
        extra = (_applied(self.names, u * gain + offset) - centre) / spread
        return namespace(u).concatenate([u, extra], axis=-1)


def _applied(names: Sequence[str], u: AnyArray) -> AnyArray:
    return namespace(u).concatenate([FUNCTIONS[name](u) for name in names], axis=-1)


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
