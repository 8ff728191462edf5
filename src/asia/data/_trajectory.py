"""Signals and records: what was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from asia.errors import UserError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Signal:
    """Name and unit of one input or output channel."""

    name: str
    unit: str = ""

    @property
    def label(self) -> str:
        """`name [unit]`, for axes and tables."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def _is_frozen(values: object) -> TypeGuard[Array]:
    """Whether nobody can write to the array any more, so that records share it."""
    if not isinstance(values, np.ndarray) or values.dtype != np.float64:
        return False
    base: object = values
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            return False
        base = base.base
    return base is None and values.ndim == 2 and values.flags.c_contiguous


def _frozen(values: object, what: str) -> Array:
    array = values if _is_frozen(values) else np.array(values, dtype=np.float64, order="C")
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise UserError(f"{what}: expected an array (samples, channels), got shape {array.shape}")
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0]
        raise UserError(
            f"{what}: missing or infinite value at sample {bad[0]}, channel {bad[1]}; "
            "fill or cut the record there"
        )
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Trajectory:
    """One contiguous record.

    u: (T, nu) inputs and y: (T, ny) outputs in physical units, float64, read-only; sampling_time
    in seconds. Raises UserError on unequal lengths and on values that are not finite.
    """

    u: Array
    y: Array
    sampling_time: float
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "u", _frozen(self.u, f"inputs of record '{self.name}'"))
        object.__setattr__(self, "y", _frozen(self.y, f"outputs of record '{self.name}'"))
        if len(self.u) != len(self.y):
            raise UserError(
                f"record '{self.name}': {len(self.u)} input samples but {len(self.y)} output "
                "samples; both need the same length"
            )

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, part: slice) -> Trajectory:
        return Trajectory(self.u[part], self.y[part], self.sampling_time, self.name)
