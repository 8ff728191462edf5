"""Training records: z-scored, cut into past windows, padded to one shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._data.cuts import Indices, rows, side_by_side, spread
from asia.models._data.scaling import Scaling

# Least share of measured past windows at which the others are left out.
_ENOUGH = 0.1
_SINGLE = np.float32


@dataclass(frozen=True)
class ScaledTrajectory:
    """Trajectory in z-scores."""

    u: Array
    """(T, nu), as they act."""
    y: Array
    """(T, ny)."""
    weight: Array
    """(T,), 0 where a sample does not count."""
    measured_u: Array
    """(T, nu), the inputs as past windows show them, where u is delayed."""
    counts: Array
    """(T,), 0 where an output was not measured; the `weight` of a whole fit."""
    filled: bool = False
    """Outputs that were not measured are those of a model."""

    def __len__(self) -> int:
        return len(self.u)

    def part(self, first: int, length: int) -> ScaledTrajectory:
        """Cut `length` samples from `first` on."""
        rows = slice(first, first + length)
        return ScaledTrajectory(
            self.u[rows],
            self.y[rows],
            self.weight[rows],
            self.measured_u[rows],
            self.counts[rows],
            self.filled,
        )

    def with_delay(self, delay: int) -> ScaledTrajectory:
        """Delay the inputs of the record; the first input is held backwards."""
        if delay == 0:
            return self
        held = np.repeat(self.u[:1], delay, axis=0)
        return replace(self, u=np.concatenate([held, self.u])[: len(self)])


ScaledData: TypeAlias = Sequence[ScaledTrajectory]
"""All records of a fit."""


def past_length(context: Context) -> int:
    """Number of samples before the first simulated one."""
    return max(context.n_past_u, context.n_past_y)


def window_size(context: Context) -> int:
    """Length of the flattened past window."""
    return context.n_past_u * context.nu + context.n_past_y * context.ny


def check(trajectories: Sequence[Trajectory], context: Context) -> None:
    """Check that there is something to simulate and every record has the right channels.

    Raises:
        UserError: if not.
    """
    if not trajectories:
        raise UserError("no training records: a model needs at least one trajectory")
    for t in trajectories:
        if t.u.shape[1] != context.nu or t.y.shape[1] != context.ny:
            raise UserError(
                f"record '{t.name}': {t.u.shape[1]} inputs and {t.y.shape[1]} outputs, "
                f"expected {context.nu} and {context.ny}"
            )
        if len(t) <= past_length(context):
            raise UserError(
                f"record '{t.name}': {len(t)} samples leave nothing to simulate after a past "
                f"window of {past_length(context)}; give a longer record or a shorter window"
            )


def scaled(trajectories: Sequence[Trajectory], scaling: Scaling) -> list[ScaledTrajectory]:
    """Scale all samples of each record to z-scores. A sample counts where every output was
    measured."""
    found: list[ScaledTrajectory] = []
    for t in trajectories:
        u, y = scaling.inputs(t.u), scaling.outputs(t.y)
        counts = measured_samples(t)
        found.append(ScaledTrajectory(u, y, counts, u, counts))
    return found


def measured_samples(record: Trajectory) -> Array:
    """Mask (T,): 1 where every output was measured, else 0; read-only where all were."""
    if record.missing is None:
        return np.broadcast_to(np.float64(1.0), len(record))
    return np.asarray(record.measured.all(axis=1), dtype=np.float64)


def refuse_gaps(trajectories: Sequence[Trajectory]) -> None:
    """Refuse records with outputs that were not measured: the correlation of the residuals in time
    would be unknown there.

    Raises:
        ValueError: if there are such outputs.
    """
    if any(t.missing is not None for t in trajectories):
        raise ValueError("standard errors need records in which every output was measured")


def window(past_u: AnyArray, past_y: AnyArray) -> AnyArray:
    """Flatten past windows: past_u (B, npu, nu), past_y (B, npy, ny) -> (B, npu*nu + npy*ny),
    z-scored alike."""
    flat = [past.reshape(past.shape[0], past.shape[1] * past.shape[2]) for past in (past_u, past_y)]
    return namespace(*flat).concatenate(flat, axis=1)


def windows(record: ScaledTrajectory, context: Context) -> Array:
    """Past windows (T - past_length, d) before each sample from `past_length` on."""
    return windows_before(record, np.arange(past_length(context), len(record)), context)


def window_rows(records: ScaledData, context: Context) -> list[Indices | slice]:
    """Rows of each record's `windows` that contain only measured outputs; all rows of all records
    if too few do."""
    past = past_length(context)
    if all(r.counts.all() for r in records):
        return [slice(None)] * len(records)
    found: list[Indices | slice] = []
    for r in records:
        lost = np.concatenate([[0], np.cumsum(r.counts == 0)])
        rows = np.arange(past, len(r))
        found.append(np.flatnonzero(lost[rows] == lost[rows - context.n_past_y]))
    enough = _ENOUGH * sum(max(0, len(r) - past) for r in records)
    few = sum(len(rows) for rows in found if not isinstance(rows, slice)) < enough
    return [slice(None)] * len(records) if few else found


def windows_before(record: ScaledTrajectory, rows: Indices, context: Context) -> Array:
    """Past windows (N, d) before samples (N,), none before `past_length`."""
    back_u = rows[:, None] + np.arange(-context.n_past_u, 0)
    back_y = rows[:, None] + np.arange(-context.n_past_y, 0)
    return window(record.measured_u[back_u], record.y[back_y])


def holdout_records(count: int, fraction: float) -> list[int]:
    """Choose records to hold out whole, spread over four or more; none of fewer."""
    left_out = round(fraction * count)
    if count < 4 or left_out < 1:
        return []
    return [int((i + 0.5) * count / left_out) for i in range(left_out)]


def holdout_masks(
    records: ScaledData, fraction: float, blocks: int = 8, shortest: int = 0
) -> list[NDArray[np.bool_]]:
    """Masks (T,) of each record, True where held out: `blocks` segments spread over it, fewer where
    they would have less than `shortest` samples.

    A simulated output depends only on inputs, so a sample whose weight is zero is unseen even
    though the simulation runs through it.
    """
    masks: list[NDArray[np.bool_]] = []
    for record in records:
        length = len(record)
        period = max(length / blocks, 4.0, min(shortest / fraction, length))
        phase = np.arange(length) % period
        masks.append((phase >= (1 - fraction) / 2 * period) & (phase < (1 + fraction) / 2 * period))
    return masks


def reweighted(
    records: ScaledData, masks: Sequence[NDArray[np.bool_]], keep: bool
) -> list[ScaledTrajectory]:
    """Keep the weight of records only where the mask equals `keep`."""
    return [replace(r, weight=r.weight * (m == keep)) for r, m in zip(records, masks, strict=True)]


def shortened(records: ScaledData, samples: int, shortest: int) -> list[ScaledTrajectory]:
    """Cut the first part of each record, about `samples` in total.

    The fraction is the same for all, but no less than `shortest` samples where the record has them;
    of
    many records only some are used, spread over them.
    """
    if sum(len(r) for r in records) <= samples:
        return list(records)
    most = max(3, samples // shortest)
    kept = [records[i] for i in spread(len(records), most)]
    fraction = samples / sum(len(r) for r in kept)
    return [r.part(0, max(shortest, round(fraction * len(r)))) for r in kept]


def contiguous_splits(
    records: ScaledData, parts: int, shortest: int
) -> list[tuple[list[ScaledTrajectory], list[ScaledTrajectory]]]:
    """Pairs (kept, left out): whole records left out in turn when there are at least `parts`, else
    segments of each record of at least `shortest` samples."""
    if len(records) >= parts:
        segments = list(records)
        groups = [list(range(i, len(segments), parts)) for i in range(parts)]
    else:
        segments = []
        membership: list[int] = []
        for r in records:
            count = max(1, min(parts, len(r) // max(shortest, 1)))
            for i, rows in enumerate(np.array_split(np.arange(len(r)), count)):
                segments.append(r.part(int(rows[0]), len(rows)))
                membership.append(i)
        groups = [[k for k, m in enumerate(membership) if m == i] for i in sorted(set(membership))]
    if len(groups) < 2:
        return [(segments, segments)]
    return [
        ([p for k, p in enumerate(segments) if k not in g], [segments[k] for k in g])
        for g in groups
    ]


@dataclass(frozen=True)
class PaddedBatch:
    """Trajectories padded to one length, in single precision, as networks are trained."""

    window: AnyArray
    """Past window of each (R, d)."""
    u: AnyArray
    """(R, T, nu)."""
    y: AnyArray
    """(R, T, ny)."""
    weight: AnyArray
    """(R, T), zero in the padding."""
    lengths: tuple[int, ...]
    """Samples of each, without the padding."""
    past_u: AnyArray
    """Inputs as past windows show them (R, n_past_u + T, nu): sample k's window begins at k."""
    past_y: AnyArray
    """Outputs likewise (R, n_past_y + T, ny)."""

    def windows_at(self, record: Indices, sample: Indices) -> AnyArray:
        """Past windows (N, d) before samples (N,) of records (N,)."""
        length = self.u.shape[1]
        each = (
            p[record[:, None], rows(sample, p.shape[1] - length)]
            for p in (self.past_u, self.past_y)
        )
        return window(*each)


def batch(records: ScaledData, context: Context) -> PaddedBatch:
    """Pad the simulated part of each record to the longest."""
    skip = past_length(context)
    first = np.array([skip])
    past_u, past_y = (
        _single([getattr(r, name)[skip - past :] for r in records])
        for name, past in (("measured_u", context.n_past_u), ("y", context.n_past_y))
    )
    return PaddedBatch(
        window=np.concatenate([windows_before(r, first, context) for r in records], dtype=_SINGLE),
        u=past_u[:, context.n_past_u :]
        if all(r.u is r.measured_u for r in records)
        else _single([r.u[skip:] for r in records]),
        y=past_y[:, context.n_past_y :],
        weight=batch_weight(records, context),
        lengths=tuple(len(r) - skip for r in records),
        past_u=past_u,
        past_y=past_y,
    )


def batch_weight(records: ScaledData, context: Context) -> AnyArray:
    """Weight of a batch of these records."""
    return _single([r.weight[past_length(context) :] for r in records])


def _single(segments: Sequence[Array]) -> AnyArray:
    single: list[AnyArray] = [np.asarray(segment, _SINGLE) for segment in segments]
    return side_by_side(single)


def delayed(past: Array, future: Array, delay: int) -> Array:
    """Inputs (B, H, nu) that act during the simulation.

    Args:
        past: measured past inputs (B, n_past_u, nu); before the first one it is held backwards.
        future: inputs (B, H, nu).
        delay: in samples.
    """
    known = np.concatenate([past, future], axis=1)
    rows = np.arange(past.shape[1], known.shape[1]) - delay
    return known[:, np.maximum(rows, 0)]


def delayed_inputs(
    scaling: Scaling, delay: int, past: Array, u: Array, first: int, stop: int
) -> Array:
    """Scaled inputs (B, stop - first, nu) that act from sample `first` on.

    Args:
        scaling: scaling of the signals.
        delay: in samples.
        past: past inputs (B, n_past_u, nu) in physical units.
        u: inputs (B, H, nu) in physical units.
        first: first sample.
        stop: sample after the last.
    """
    begin = max(first - delay, 0)
    known, part = scaling.inputs(past), scaling.inputs(u[:, begin:stop])
    return delayed(known, part, delay)[:, first - begin :]
