"""Signals and trajectories, with their digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, Literal, TypeGuard

import numpy as np
from numpy.typing import NDArray

from asia.errors import UserError

# Signals and measured records.


Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Intersample = Literal["zero", "first", "band_limited"]
"""Behaviour of an input between samples: held, on straight lines, or band-limited."""
INTERSAMPLE: Final[Mapping[Intersample, str]] = MappingProxyType(
    {"zero": "held", "first": "linear", "band_limited": "band-limited"}
)
"""Words for it, as in "inputs held between samples"."""
MOST_DELAY = 10
"""Greatest delay of an input that a fit looks for by itself, in samples."""


@dataclass(frozen=True)
class Signal:
    """Name and unit of one input or output channel."""

    name: str
    unit: str = ""
    role: Literal["disturbance", "scheduling", "time_step"] | None = None
    """"disturbance": a measured input that nobody sets, such as the weather.
    "scheduling": a measured input that the coefficients of linear models may follow.
    "time_step": an input that holds the time in s from each sample to the next, of records that are
    not sampled regularly."""
    intersample: Intersample | None = None
    """Behaviour of an input between samples; None leaves the choice to the search."""

    @property
    def is_actuated(self) -> bool:
        """Whether somebody sets this input."""
        return self.role not in ("disturbance", "time_step")

    @property
    def label(self) -> str:
        """`name [unit]`, for axes and tables."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def real_numbers(values: object, what: str) -> Array:
    """Numbers as float64, NaN where a masked array is masked. Raises UserError for complex numbers
    and for values that are no numbers."""
    array: Any = values if isinstance(values, np.ndarray) else np.asarray(values)
    if array.dtype.kind == "c":
        raise UserError(
            f"{what} holds complex numbers, expected real ones: give the real part, or real and "
            "imaginary parts as two signals"
        )
    try:
        if isinstance(array, np.ma.MaskedArray):
            return np.ma.filled(array.astype(np.float64), np.nan)
        return array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{what} cannot be converted to numbers: {error}") from None


def _is_frozen(values: object) -> TypeGuard[Array]:
    """Return whether the array is read-only, so that records can share it."""
    if not isinstance(values, np.ndarray) or values.dtype != np.float64:
        return False
    base: object = values
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            return False
        base = base.base
    return base is None and values.ndim == 2 and values.flags.c_contiguous


def _frozen(values: object, what: str, *, gaps: bool = False) -> Array:
    array = values if _is_frozen(values) else np.ascontiguousarray(real_numbers(values, what))
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise UserError(f"{what}: expected an array (samples, channels), got shape {array.shape}")
    wrong = np.isinf(array) if gaps else ~np.isfinite(array)
    if wrong.any():
        bad = np.argwhere(wrong)[0]
        raise UserError(
            f"{what}: the value at sample {bad[0] + 1}, channel {bad[1] + 1} is "
            f"{'infinite' if gaps else 'missing or infinite'}: fill or cut the record there"
        )
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Trajectory:
    """One contiguous record.

    NaN in `y` is an output that was not measured: there `missing` is True, and `y` has the straight
    line between the measured neighbours, the nearest one at the ends. A value given where `missing`
    is True is replaced by that line.

    Attributes:
        u: (T, nu) inputs in physical units, float64, read-only
        y: (T, ny) outputs in physical units, float64, read-only
        sampling_time: s

    Raises:
        UserError: on unequal lengths, on other values that are not finite, and on an output
            never measured
    """

    u: Array
    y: Array
    sampling_time: float
    name: str = ""
    missing: Mask | None = field(default=None)
    """(T, ny), True where an output was not measured; None where all were."""
    reference: Array | None = None
    """(T, nr), references of the feedback loop in which the record was taken; None without one."""

    def __post_init__(self) -> None:
        what = f"outputs of record '{self.name}'"
        object.__setattr__(self, "u", _frozen(self.u, f"inputs of record '{self.name}'"))
        object.__setattr__(self, "y", _frozen(self.y, what, gaps=True))
        found = np.isnan(self.y)
        if found.any() or self.missing is not None:
            missing = found if self.missing is None else found | self.missing
            never = missing.all(axis=0)
            if found[:, never].any():
                raise UserError(
                    f"{what}: output {int(np.argmax(never)) + 1} was never measured; leave the "
                    "output or the record out"
                )
            y = np.where(never, self.y, filled(np.where(missing, np.nan, self.y)))
            object.__setattr__(self, "y", _frozen(y, what))
            object.__setattr__(self, "missing", missing)
        if self.missing is not None:
            missing = np.array(self.missing, dtype=np.bool_)
            missing.flags.writeable = False
            object.__setattr__(self, "missing", missing if missing.any() else None)
        if self.reference is not None:
            what = f"references of record '{self.name}'"
            object.__setattr__(self, "reference", _frozen(self.reference, what))
        if len(self.u) != len(self.y):
            raise UserError(
                f"record '{self.name}': {len(self.u)} input samples but {len(self.y)} output "
                "samples; both need the same length"
            )

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, part: slice) -> Trajectory:
        missing = None if self.missing is None else self.missing[part]
        reference = None if self.reference is None else self.reference[part]
        u, y = self.u[part], self.y[part]
        found = Trajectory(u, y, self.sampling_time, self.name, missing, reference)
        # Gaps keep the line to neighbours outside the part.
        object.__setattr__(found, "y", _frozen(y, f"outputs of record '{self.name}'"))
        return found

    @property
    def measured(self) -> Mask:
        """(T, ny), True where an output was measured."""
        if self.missing is None:
            return np.broadcast_to(np.True_, self.y.shape)
        return ~self.missing

    @property
    def measured_y(self) -> Array:
        """(T, ny), the outputs with NaN where they were not measured."""
        return self.y if self.missing is None else np.where(self.missing, np.nan, self.y)

    def alone(self, start: int, stop: int) -> Trajectory:
        """The samples from `start` to before `stop`, filled from these alone."""
        if self.missing is None:
            return self[start:stop]
        y, reference = self.measured_y[start:stop], self[start:stop].reference
        step, name = self.sampling_time, self.name
        return Trajectory(self.u[start:stop], y, step, name, reference=reference)


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names, a later one that was there before with `_2`, `_3` and so on behind it."""
    found: dict[str, None] = {}
    for name in names:
        number, own = 2, name
        while own in found:
            own, number = f"{name}_{number}", number + 1
        found[own] = None
    return tuple(found)


def filled(values: Array) -> Array:
    """values (T, n) with NaN -> on straight lines between the neighbours, held at the ends; a
    column of NaN is zero."""
    if not np.isnan(values).any():
        return values
    time, found = np.arange(len(values)), np.zeros_like(values)
    for column, known in enumerate(~np.isnan(values).T):
        if known.any():
            found[:, column] = np.interp(time, time[known], values[known, column])
    return found


def spread_of(values: Array) -> Array:
    """Standard deviation (n,), ddof 0, of the numbers in each column of (T, n), NaN left out."""
    return np.nanstd(values, axis=0) if np.isnan(values).any() else values.std(axis=0)


# sha256 of records.


def data_digest(trajectories: Sequence[Trajectory]) -> str:
    """Hex sha256 over sampling times, shapes and values, in order; names do not count.
    An output that was not measured counts as NaN."""
    digest = hashlib.sha256()
    for t in trajectories:
        digest.update(json.dumps([t.sampling_time, t.u.shape, t.y.shape]).encode())
        for values in (t.u, t.measured_y, *(() if t.reference is None else (t.reference,))):
            digest.update(np.ascontiguousarray(values, "<f8").data)
    return digest.hexdigest()


# Sizes of signals.


# A signal that moves by less than so many roundings of its magnitude is constant.
_ULPS = 8.0


def is_constant(values: Array) -> bool:
    """Return whether a signal moves by no more than its rounding."""
    size = float(np.abs(values).max(initial=0.0))
    return not values.size or float(np.ptp(values)) <= _ULPS * np.finfo(float).eps * size


def deviations(values: Array) -> Array:
    """Return the standard deviations (n,) of signals (T, n); 1 for a constant one."""
    return np.where([is_constant(v) for v in values.T], 1.0, values.std(axis=0))


# Values that double precision can be reckoned with: their squares neither overflow nor vanish.


LARGEST_VALUE = 1e100
"""The largest magnitude of a sample. Errors are squared and summed; double precision ends at about
1e308."""
LEAST_RANGE = 1e-100
"""The least range of a training signal that moves: of a smaller one the variance comes out as 0."""


def check_magnitudes(
    trajectories: Sequence[Trajectory], inputs: Sequence[str], outputs: Sequence[str], what: str
) -> None:
    """Raise UserError for a sample above the largest magnitude.

    Args:
        what: kind of the records, for the message
    """
    for t in trajectories:
        for role, names, values in (("input", inputs, t.u), ("output", outputs, t.y)):
            magnitudes = np.abs(values)
            if not values.size or magnitudes.max() <= LARGEST_VALUE:
                continue
            sample, channel = (int(i) for i in np.argwhere(magnitudes > LARGEST_VALUE)[0])
            raise UserError(
                f"{role} '{names[channel]}' of {what} record '{t.name}' is "
                f"{values[sample, channel]:.3g} at sample {sample + 1}, expected a magnitude of at "
                f"most {LARGEST_VALUE:g}, since its square must not overflow: correct the "
                "sample, or give "
                "the signal in a larger unit (divide its column by a power of ten)"
            )


def check_ranges(
    trajectories: Sequence[Trajectory], inputs: Sequence[str], outputs: Sequence[str]
) -> None:
    """Raise UserError for a signal that moves, but so little that its variance comes out as 0."""
    for role, names, channels in (
        ("input", inputs, [t.u for t in trajectories]),
        ("output", outputs, [t.y for t in trajectories]),
    ):
        values = np.concatenate(channels) if channels else np.zeros((0, 0))
        if not values.size:
            continue
        for name, span in zip(names, np.ptp(values, axis=0).tolist(), strict=True):
            if 0 < span < LEAST_RANGE:
                raise UserError(
                    f"{role} '{name}' moves by {span:.3g} in all training records together, "
                    f"expected a range of at least {LEAST_RANGE:g}, since its square must not "
                    "vanish: give the signal in a smaller unit (multiply its column by a power of "
                    "ten)"
                )
