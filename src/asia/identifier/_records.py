"""Arrays and data frames of a user, as records."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from asia.data import Array
from asia.errors import UserError

_JITTER = 0.01
_NANOSECOND = 1e-9


def sampling_time_of(values: Sequence[Any], given: float | None) -> float:
    """The sampling time in seconds: as given, or from the time index of every data frame. Raises
    UserError where there is neither, where they differ, and where the steps are not equal."""
    found = {round(step, 12) for one in values if (step := _step(one)) is not None}
    if len(found) > 1:
        steps = ", ".join(f"{step:g} s" for step in sorted(found))
        raise UserError(f"the time indices have different steps ({steps}): resample them to one")
    index = found.pop() if found else None
    if given is None and index is None:
        raise UserError("the sampling time is not known: give sampling_time=..., in seconds")
    if given is not None and index is not None and abs(given - index) > _JITTER * index:
        raise UserError(
            f"sampling_time is {given:g} s, but the time index has steps of {index:g} s"
        )
    chosen = given if given is not None else index
    assert chosen is not None
    if not chosen > 0:
        raise UserError(f"sampling_time is {chosen:g} s, expected more than 0")
    return chosen


def check_times(u: Sequence[Any], y: Sequence[Any]) -> None:
    """Raises UserError where inputs and outputs of a record have time indices that begin at
    different times."""
    for k, (one, other) in enumerate(zip(u, y, strict=False), 1):
        starts = [t[0] for v in (one, other) if len(t := _times(v))]
        step = _step(one)
        if len(starts) < 2 or step is None or starts[0].dtype.kind != starts[1].dtype.kind:
            continue
        apart = abs(float((starts[1] - starts[0]) / np.timedelta64(1, "ns"))) * _NANOSECOND
        if apart > _JITTER * step:
            raise UserError(
                f"record {k}: the time index of y begins {apart:g} s away from that of u: cut both "
                "to the same times"
            )


def _times(values: Any) -> Any:
    times = np.asarray(getattr(values, "index", ()))
    return times if times.dtype.kind in "mM" else times[:0]


def _step(values: Any) -> float | None:
    """Seconds from row to row; None without a time index."""
    times = _times(values)
    if len(times) < 2:
        return None
    steps = np.diff(times.astype(f"{times.dtype.kind}8[ns]").astype(np.int64)) * _NANOSECOND
    middle = float(np.median(steps))
    if middle <= 0 or np.abs(steps - middle).max() > _JITTER * middle:
        row = int(np.argmax(np.abs(steps - middle)))
        raise UserError(
            f"the time index is not equally spaced: {steps[row]:g} s after row {row}, {middle:g} s "
            "in the median; resample the data frame, or cut it into a list of records"
        )
    return middle


def digest_of(arrays: Sequence[Array], *settings: object) -> str:
    """8 hexadecimal digits of records and settings: the same ones have the same name."""
    found = hashlib.sha256(repr(settings).encode())
    for array in arrays:
        found.update(repr(array.shape).encode() + array.astype("<f8").tobytes())
    return found.hexdigest()[:8]
