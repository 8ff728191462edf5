"""Values that double precision can be reckoned with: their squares neither overflow nor vanish."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data._trajectory import Array, Trajectory
from asia.errors import UserError

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
    if not trajectories:
        return
    _check_range([t.u for t in trajectories], "input", inputs)
    _check_range([t.y for t in trajectories], "output", outputs)


def _check_range(arrays: Sequence[Array], role: str, names: Sequence[str]) -> None:
    values = np.concatenate(arrays)
    if not values.size:
        return
    for name, span in zip(names, np.ptp(values, axis=0).tolist(), strict=True):
        if 0 < span < LEAST_RANGE:
            raise UserError(
                f"{role} '{name}' moves by {span:.3g} in all training records together, expected "
                f"a range of at least {LEAST_RANGE:g}, since its square must not vanish: give the "
                "signal in a smaller unit (multiply its column by a power of ten)"
            )
