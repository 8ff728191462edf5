"""Mean Euclidean Error: one distance a group of outputs, at each step of a window.

At step h the distance of measured and simulated vectors is averaged over all windows; attitude
counts by the geodesic distance of its rotations.

Source: Busetto et al. (2026), nanodrone benchmark.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array
from asia.errors import InternalError, UserError
from asia.judge.scoring.outcome import check_reply
from asia.problem.protocol import OutputGroup


@dataclass(frozen=True)
class GroupError:
    """Mean distance of one group of outputs at steps 1..H, in its unit (rotations: rad). Raises
    InternalError when a number is not finite."""

    name: str
    steps: tuple[float, ...]

    def __post_init__(self) -> None:
        if not np.isfinite(self.steps).all():
            raise InternalError("a distance that is not finite was about to be recorded")

    def at(self, step: int) -> float:
        """Return the error at step 1..H."""
        return self.steps[step - 1]

    @property
    def total(self) -> float:
        """Sum over the steps."""
        return float(sum(self.steps))


@dataclass(frozen=True)
class MeeTable:
    """Table with a row for each group; `horizons` are the steps that tables show next to the
    sum."""

    horizons: tuple[int, ...]
    groups: tuple[GroupError, ...]

    def by_group(self) -> dict[str, dict[str, float]]:
        """Group -> h10, h50, ..., sum."""
        return {
            g.name: {**{f"h{h}": g.at(h) for h in self.horizons}, "sum": g.total}
            for g in self.groups
        }


def mee_table(
    y: Sequence[Array],
    y_hat: Sequence[Array],
    outputs: Sequence[str],
    groups: Sequence[OutputGroup],
    horizons: Sequence[int],
) -> MeeTable:
    """Mean Euclidean Error over windows of one length.

    Args:
        y, y_hat: measured and simulated outputs, one (H, ny) array a window
        outputs: the ny names
        horizons: steps 1..H, none for the last alone

    Raises:
        CandidateError: for a reply of the wrong size or not finite
        UserError: for a step that no window measures
    """
    for measured, simulated in zip(y, y_hat, strict=True):
        check_reply(simulated, measured.shape)
    a, b = np.stack(list(y)), np.stack(list(y_hat))
    found: list[GroupError] = []
    for group in groups:
        columns = [list(outputs).index(name) for name in group.outputs]
        measure = geodesic if group.distance == "geodesic" else euclidean
        distance = measure(a[..., columns], b[..., columns])
        # Over the windows in which all outputs of the group were measured.
        missing = np.isnan(distance)
        never = missing.all(axis=0)
        if never.any():
            raise UserError(f"step {int(np.argmax(never)) + 1} is measured in no window")
        mean = np.nanmean if missing.any() else np.mean
        found.append(GroupError(group.name, tuple(mean(distance, axis=0).tolist())))
    return MeeTable(tuple(horizons) or (a.shape[1],), tuple(found))


def euclidean(a: Array, b: Array) -> Array:
    """Distance of vectors (..., n) -> (...)."""
    return np.linalg.norm(a - b, axis=-1)


def geodesic(a: Array, b: Array) -> Array:
    """Angle in rad, 0 to pi, of the rotation between two attitudes (..., 3), roll, pitch and yaw in
    rad (Z-Y-X).

    With the relative rotation's trace t and its antisymmetric part s it is arctan2(|s|, (t - 1)/2):
    the usual arccos((t - 1)/2) loses half the digits near 0 and pi, and leaves its range by
    rounding.
    """
    relative = np.swapaxes(rotation(a), -1, -2) @ rotation(b)
    trace = np.trace(relative, axis1=-2, axis2=-1)
    skew = (relative - np.swapaxes(relative, -1, -2)) / 2.0
    sine = np.sqrt((skew**2).sum(axis=(-1, -2)) / 2.0)
    return np.arctan2(sine, (trace - 1.0) / 2.0)


def rotation(angles: Array) -> Array:
    """Body-to-world matrices (..., 3, 3) = Rz(yaw) Ry(pitch) Rx(roll) of (..., 3) roll, pitch, yaw
    in rad."""
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(angles), -1, 0) for f in (np.sin, np.cos))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
