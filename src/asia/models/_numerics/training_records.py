"""Training records as the models see them: z-scored, cut into windows, padded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._numerics.scaling import Scaling

# Cuts of records, and padding of segments of unequal length to one array.

Indices = NDArray[np.intp]


def laid_end_to_end(samples: int, span: int, overlap: bool = True) -> Indices:
    """First samples of segments of `span` samples that cover `samples`, one after the other.

    The last segment ends with the samples and overlaps its neighbour where `span` does not divide
    them; without `overlap` it is shorter instead.
    """
    starts = np.arange(0, samples, span)
    return np.minimum(starts, max(samples - span, 0)) if overlap else starts


def spread(count: int, most: int) -> Indices:
    """Choose at most `most` of the numbers 0 .. count-1, spread evenly over them."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(np.intp)


def rows(starts: Sequence[int] | Indices, length: int) -> Indices:
    """Samples (N, length) of the segments that begin at `starts`."""
    return np.asarray(starts)[:, None] + np.arange(length)


def padded(values: Array, length: int, how: Literal["constant", "edge"] = "constant") -> Array:
    """Pad values (T, ...) to `length` rows, with zeros or by repeating the last row."""
    missing = [(0, length - len(values))] + [(0, 0)] * (values.ndim - 1)
    return np.pad(values, missing, mode=how)


def side_by_side(segments: Sequence[Array], how: Literal["constant", "edge"] = "constant") -> Array:
    """Stack segments (T_i, ...) -> (N, T, ...), padded to the longest."""
    longest = max(len(segment) for segment in segments)
    return np.stack([padded(segment, longest, how) for segment in segments])


# Training records: z-scored, cut into past windows, padded to one shape.

# Least share of measured past windows at which the others are left out.
_ENOUGH = 0.1
_SINGLE = np.float32


@dataclass(frozen=True)
class ScaledTrajectory:
    """Trajectory in z-scores."""

    u: Array  # (T, nu), as they act
    y: Array  # (T, ny)
    weight: Array  # (T, ny), 0 where an output does not count
    undelayed_u: Array  # (T, nu), the inputs as past windows show them, where u is delayed
    counts: Array  # (T, ny), 0 where an output was not measured; the `weight` of a whole fit
    filled: bool = False  # Outputs that were not measured are those of a model

    def __len__(self) -> int:
        return len(self.u)

    def part(self, first: int, length: int) -> ScaledTrajectory:
        """Cut `length` samples from `first` on."""
        rows = slice(first, first + length)
        arrays = self.u, self.y, self.weight, self.undelayed_u, self.counts
        return ScaledTrajectory(*(values[rows] for values in arrays), filled=self.filled)

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
    """Check that there is something to simulate and every record has the right channels. Raises
    UserError if not."""
    if not trajectories:
        raise UserError("no training records: a model needs at least one trajectory")
    if any(s.role == "time_step" for s in context.inputs):
        raise UserError(
            "the records are not sampled regularly, and this family counts in samples: use "
            "greybox, hybrid or simulator, or leave out the input with role 'time_step' to have "
            "the records resampled"
        )
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
    """Scale all samples of each record to z-scores. Each output counts where it was measured."""
    found: list[ScaledTrajectory] = []
    for t in trajectories:
        u, counts = scaling.inputs(t.u), measured_weight(t)
        found.append(ScaledTrajectory(u, scaling.outputs(t.y), counts, u, counts))
    return found


def measured_weight(record: Trajectory) -> Array:
    """Weight (T, ny) of the outputs of a training record in every fit: 1 where measured, 0 in the
    gaps, where `record.y` has values without influence; read-only where all were measured."""
    if record.missing is None:
        return np.broadcast_to(np.float64(1.0), record.y.shape)
    return np.asarray(record.measured, dtype=np.float64)


def output_groups(weight: Array) -> list[tuple[Indices | slice, Indices]]:
    """Rows of a regression in which an output counts, by weight (N, ny), and the outputs with these
    same rows."""
    counts = weight > 0
    if counts.all():
        return [(slice(None), np.arange(weight.shape[1]))]
    masks, group = np.unique(counts, axis=1, return_inverse=True)
    return [
        (np.flatnonzero(mask), np.flatnonzero(group.ravel() == i)) for i, mask in enumerate(masks.T)
    ]


def regress_outputs(
    x: Array, y: Array, weight: Array, solve: Callable[[Array, Array], AnyArray]
) -> Array:
    """Coefficients (M, ny) of y (N, ny) on x (N, M): `solve` maps the rows (n, M) in which some
    outputs count, and these outputs (n, k), to their coefficients (M, k)."""
    groups = output_groups(weight)
    theta = np.concatenate([solve(x[rows], y[rows][:, which]) for rows, which in groups], axis=1)
    return theta[:, np.argsort(np.concatenate([which for _, which in groups]))]


def flat_past(past_u: AnyArray, past_y: AnyArray) -> AnyArray:
    """Flatten past windows: past_u (B, npu, nu), past_y (B, npy, ny) -> (B, npu*nu + npy*ny),
    z-scored alike."""
    flat = [past.reshape(past.shape[0], past.shape[1] * past.shape[2]) for past in (past_u, past_y)]
    return namespace(*flat).concatenate(flat, axis=1)


def past_windows(record: ScaledTrajectory, context: Context) -> Array:
    """Past windows (T - past_length, d) before each sample from `past_length` on."""
    return past_windows_before(record, np.arange(past_length(context), len(record)), context)


def window_rows(records: ScaledData, context: Context) -> list[Indices | slice]:
    """Rows of each record's `past_windows` that contain only measured outputs; all rows of all
    records if too few do."""
    past = past_length(context)
    if all(r.counts.all() for r in records):
        return [slice(None)] * len(records)
    found: list[Indices | slice] = []
    for r in records:
        lost = np.concatenate([[0], np.cumsum((r.counts == 0).any(axis=1))])
        rows = np.arange(past, len(r))
        found.append(np.flatnonzero(lost[rows] == lost[rows - context.n_past_y]))
    enough = _ENOUGH * sum(max(0, len(r) - past) for r in records)
    few = sum(len(rows) for rows in found if not isinstance(rows, slice)) < enough
    return [slice(None)] * len(records) if few else found


def past_windows_before(record: ScaledTrajectory, rows: Indices, context: Context) -> Array:
    """Past windows (N, d) before samples (N,), none before `past_length`."""
    back_u = rows[:, None] + np.arange(-context.n_past_u, 0)
    back_y = rows[:, None] + np.arange(-context.n_past_y, 0)
    return flat_past(record.undelayed_u[back_u], record.y[back_y])


def holdout_records(count: int, fraction: float) -> list[int]:
    """Choose records to hold out whole, spread over four or more; none of fewer."""
    left_out = round(fraction * count)
    if count < 4 or left_out < 1:
        return []
    return [int((i + 0.5) * count / left_out) for i in range(left_out)]


def holdout_masks(
    records: ScaledData, fraction: float, blocks: int = 8, shortest: int = 0
) -> list[NDArray[np.bool_]]:
    """Masks (T, 1) of each record, True where held out: `blocks` segments spread over it, fewer
    where they would have less than `shortest` samples.

    A simulated output depends only on inputs, so a sample whose weight is zero is unseen even
    though the simulation runs through it.
    """
    masks: list[NDArray[np.bool_]] = []
    for record in records:
        length = len(record)
        period = max(length / blocks, 4.0, min(shortest / fraction, length))
        phase = np.arange(length)[:, None] % period
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
    of many records only some are used, spread over them.
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


class SegmentBatch(NamedTuple):
    """Segments side by side, z-scored: windows, chunks, or records padded to one length. JAX reads
    it as a tree of its arrays."""

    window: AnyArray  # Past window of each, flattened (B, d)
    u: AnyArray  # Inputs after it (B, T, nu)
    y: AnyArray  # Outputs after it (B, T, ny)
    weight: AnyArray  # (B, T, ny), 0 where an output was not measured or does not count
    lengths: AnyArray = ()  # Samples of each record without the padding (B,); () of segments
    past_u: AnyArray = None
    """Inputs before each (B, n_past_u, nu), where these are kept apart. Of records with those after
    them (B, n_past_u + T, nu), as past windows show them: sample k's window begins at k."""
    past_y: AnyArray = None  # Outputs likewise (B, n_past_y, ny) or (B, n_past_y + T, ny)

    def windows_at(self, record: Indices, sample: Indices) -> AnyArray:
        """Past windows (N, d) before samples (N,) of records (N,)."""
        length = self.u.shape[1]
        each = (
            p[record[:, None], rows(sample, p.shape[1] - length)]
            for p in (self.past_u, self.past_y)
        )
        return flat_past(*each)


def batch(records: ScaledData, context: Context) -> SegmentBatch:
    """Pad the simulated part of each record to the longest, in single precision, as networks are
    trained."""
    skip = past_length(context)
    first = np.array([skip])
    past_u, past_y = (
        _single([getattr(r, name)[skip - past :] for r in records])
        for name, past in (("undelayed_u", context.n_past_u), ("y", context.n_past_y))
    )
    return SegmentBatch(
        window=np.concatenate(
            [past_windows_before(r, first, context) for r in records], dtype=_SINGLE
        ),
        u=past_u[:, context.n_past_u :]
        if all(r.u is r.undelayed_u for r in records)
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
    """Inputs (B, H, nu) that act during the simulation, `delay` samples after the future ones;
    before the first of the past inputs (B, n_past_u, nu) that is held backwards."""
    known = np.concatenate([past, future], axis=1)
    rows = np.arange(past.shape[1], known.shape[1]) - delay
    return known[:, np.maximum(rows, 0)]


def delayed_inputs(
    scaling: Scaling, delay: int, past: Array, u: Array, first: int, stop: int
) -> Array:
    """Scaled inputs (B, stop - first, nu) that act from sample `first` on; past inputs (B,
    n_past_u, nu) and inputs u (B, H, nu) are in physical units."""
    begin = max(first - delay, 0)
    known, part = scaling.inputs(past), scaling.inputs(u[:, begin:stop])
    return delayed(known, part, delay)[:, first - begin :]


# Training windows: segments of the protocol's horizon, each with its own past window.

# Greatest number of segments from one record: few long ones, so that slow modes show.
_MOST_SEGMENTS = 4


def cut_windows(records: ScaledData, context: Context, most: int) -> SegmentBatch:
    """Cut at most about `most` windows of `context.horizon` samples (of the longest record, where
    all are shorter), evenly spread over the records and of every record the same share."""
    past = past_length(context)
    longest = max(len(r) for r in records) - past
    horizon = min(context.horizon or longest, longest)
    usable = [r for r in records if len(r) - past >= horizon]
    places = [len(r) - past - horizon + 1 for r in usable]
    stride = max(1, -(-sum(places) // max(most, 1)))
    parts = list[tuple[Array, ...]]()
    for r, count in zip(usable, places, strict=True):
        starts = np.arange((count - 1) % stride // 2, count, stride)
        simulated = rows(past + starts, horizon)
        signals = (values[simulated] for values in (r.u, r.y, r.counts))
        parts.append((past_windows(r, context)[starts], *signals))
    return SegmentBatch(*map(np.concatenate, zip(*parts, strict=True)))


def whole_windows(records: ScaledData, context: Context, horizon: int, most: int) -> SegmentBatch:
    """Cut at most about `most` windows of `horizon` samples that lie end to end in each record,
    none cut by its end, spread over all records."""
    past = past_length(context)
    counts = [(len(r) - past) // horizon for r in records]
    stride = max(1, round(sum(max(count, 1) for count in counts) / most))
    places = [(i, k * horizon) for i, count in enumerate(counts) for k in range(count)][::stride]
    features = [past_windows(r, context) for r in records]
    segments = [records[i].part(past + k, horizon) for i, k in places]
    return SegmentBatch(
        np.stack([features[i][k] for i, k in places]),
        np.stack([segment.u for segment in segments]),
        np.stack([segment.y for segment in segments]),
        np.stack([segment.counts for segment in segments]),
    )


def mean_square(error: Array, weight: Array) -> float:
    """Mean square of errors (..., ny) where weight (..., ny) is 1."""
    return float((weight * error**2).sum()) / max(float(weight.sum()), 1.0)


def stretches(records: ScaledData, samples: int, shortest: int) -> list[ScaledTrajectory]:
    """Choose segments of up to about `samples` samples in all.

    These are the records themselves where they hold no more, else segments of at least `shortest`
    samples (where a record has them), evenly spread over each record, of very many records only
    over some.
    """
    total = sum(len(r) for r in records)
    if total <= samples:
        return list(records)
    most = max(1, samples // shortest)
    kept = [records[i] for i in spread(len(records), most)]
    share = samples / sum(len(r) for r in kept)
    segments: list[ScaledTrajectory] = []
    for r in kept:
        count = int(np.clip(share * len(r) // shortest, 1, _MOST_SEGMENTS))
        length = min(len(r), max(shortest, int(share * len(r) / count)))
        starts = np.linspace(0, len(r) - length, count).round().astype(int)
        segments += [r.part(int(start), length) for start in starts]
    return segments
