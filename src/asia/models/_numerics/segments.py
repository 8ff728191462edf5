"""Segments and chunks of records that training simulates."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models._arrays import AnyArray, namespace
from asia.models._numerics.training_records import (
    ScaledData,
    SegmentBatch,
    contiguous_splits,
    flat_past,
    laid_end_to_end,
    mean_square,
    past_length,
    rows,
    side_by_side,
    spread,
)

# Segments over which a model is simulated for its fit or choice, and the error on them.
#
# With a horizon they are windows of that length, as the model will be evaluated; without one they
# are whole records.

# Longest segment in samples. Longer records are cut and their segments simulated side by side: the
# time of a loop grows with its length.
_LONGEST = 4000
_MOST_SAMPLES = 40_000
_SIGNALS = "u", "y", "counts"


class ScaledSimulator(Protocol):
    """Fitted model in z-scores."""

    def __call__(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate as `simulate` of a model does, all z-scored."""
        ...


def segments(
    records: ScaledData, context: Context, samples: int = _MOST_SAMPLES
) -> SegmentBatch | None:
    """Segments of the records after their past windows, about `samples` in total, evenly spread
    where there are more; None where every record is too short for one."""
    past = past_length(context)
    places = [(r, first) for r in records for first in _firsts(len(r), past, context.horizon)]
    if not places:
        return None
    longest = context.horizon or _LONGEST
    lengths = [min(longest, len(r) - first) for r, first in places]
    most = max(1, samples // max(lengths))
    chosen = spread(len(places), most)
    cuts = [(*places[i], places[i][1] + lengths[i]) for i in chosen]
    past_u = np.stack([r.undelayed_u[k - context.n_past_u : k] for r, k, _ in cuts])
    past_y = np.stack([r.y[k - context.n_past_y : k] for r, k, _ in cuts])
    return SegmentBatch(
        flat_past(past_u, past_y),
        *(side_by_side([getattr(r, name)[k:end] for r, k, end in cuts]) for name in _SIGNALS),
        past_u=past_u,
        past_y=past_y,
    )


def simulation_error(simulate: ScaledSimulator, data: SegmentBatch) -> float:
    """Weighted mean squared error over samples and channels, infinite where it diverges."""
    with np.errstate(all="ignore"):
        misfit = simulate(data.past_u, data.past_y, data.u) - data.y
        error = mean_square(misfit, data.weight)
    return error if np.isfinite(error) else float("inf")


def left_out_error(
    records: ScaledData,
    context: Context,
    fit: Callable[[ScaledData], Sequence[ScaledSimulator]],
    memory: int,
) -> Array:
    """Mean over splits of the log of the mean squared simulation error on the samples left out, for
    each of the simulators that `fit` makes from the kept samples; infinite where one diverges.

    Whole records are left out when there are at least three, else segments of them of at least
    four times the model's `memory` in samples, and two past windows.
    """
    logs: list[list[float]] = []
    shortest = 2 * past_length(context) + 4 * memory
    for kept, left in contiguous_splits(records, 3, shortest):
        data = segments(left, context)
        if data is None or not kept:
            continue
        logs.append([np.log(simulation_error(s, data) + 1e-300) for s in fit(kept)])
    return np.mean(logs, axis=0) if logs else np.zeros(1)


def window_segments(
    trajectories: Sequence[Trajectory], context: Context, most: int
) -> list[Trajectory]:
    """Cut past window and horizon as separate records, `most` of them spread evenly; the records
    themselves where the protocol has no horizon."""
    if context.horizon is None:
        return list(trajectories)
    past, horizon = past_length(context), context.horizon
    places = [(t, k - past) for t in trajectories for k in _firsts(len(t), past, horizon)]
    kept = [places[i] for i in spread(len(places), most)]
    return [t[k : k + past + horizon] for t, k in kept]


def _firsts(length: int, past: int, horizon: int | None) -> list[int]:
    """First simulated samples; the last window ends with the record."""
    starts = laid_end_to_end(length - past, horizon or _LONGEST, overlap=horizon is not None)
    return (past + starts).tolist()


# Simulations of one training step: whole records, chunks laid end to end, or chunks at random
# places.
#
# All arrays are z-scored float32, in NumPy but for random chunks; T is the length of a simulation,
# B the number that run in parallel.


class Places(NamedTuple):
    """Trajectories, and the permitted starts of chunks in them."""

    u: AnyArray  # (R, T, nu)
    y: AnyArray  # (R, T, ny)
    weight: AnyArray  # (R, T, ny)
    past_u: AnyArray  # (R, n_past_u + T, nu), see `SegmentBatch`
    past_y: AnyArray  # (R, n_past_y + T, ny)
    ends: AnyArray  # Number of starts in each record and those before it (R,)
    moves: AnyArray  # (R,), 0 where all starts of a record are its first sample, else 1
    share: AnyArray | None = None
    """Probability (S,) that a chunk starts at one of the starts up to each; None: uniform."""

    def at(self, picked: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Records and samples of starts, both as `picked`."""
        xp = namespace(picked)
        record = xp.searchsorted(self.ends, picked, side="right")
        before = xp.where(record > 0, self.ends[record - 1], 0)
        return record, (picked - before) * self.moves[record]


def whole(batch: SegmentBatch) -> SegmentBatch:
    """Convert each record to one simulation."""
    arrays = (batch.window, batch.u, batch.y, batch.weight)
    return SegmentBatch(*(np.asarray(a, np.float32) for a in arrays))


def laid(batch: SegmentBatch, length: int, overlap: bool = True) -> SegmentBatch:
    """Cut chunks of `length` samples end to end, in time order within each record.

    The last chunk of a record ends with it, overlapping its neighbour, or without `overlap` is
    padded.
    """
    length = min(length, batch.u.shape[1])
    begins = [laid_end_to_end(total, length, overlap) for total in batch.lengths]
    record, begin = np.repeat(np.arange(len(begins)), [*map(len, begins)]), np.concatenate(begins)
    samples = rows(begin, length)
    inside = samples < batch.u.shape[1]
    at = record[:, None], np.minimum(samples, batch.u.shape[1] - 1)
    weight = batch.weight[at] * inside[..., None]
    arrays = batch.windows_at(record, begin), batch.u[at], batch.y[at], weight
    return SegmentBatch(*(np.asarray(a, np.float32) for a in arrays))


def places(batch: SegmentBatch, length: int) -> Places:
    """Permit every start from which a whole chunk fits.

    A shorter record starts at its first sample, as often as it has samples, so that it is drawn as
    often.
    """
    own = np.asarray(batch.lengths)
    short = own < length
    counts = np.where(short, own, own - length + 1)
    if short.all():
        counts = np.ones_like(own)
    ends, moves = (np.asarray(a, np.int32) for a in (np.cumsum(counts), ~short))
    return Places(batch.u, batch.y, batch.weight, batch.past_u, batch.past_y, ends, moves)


def gently(p: Places, length: int, power: float) -> Places:
    """Draw chunks in proportion to their amplitude to the power -`power`."""
    moved = np.diff(p.y, axis=1) * (p.weight[:, 1:] > 0)
    size = np.sqrt((moved**2).mean(axis=(0, 1)))
    squares = ((moved / np.where(size > 0, size, 1.0)) ** 2).mean(axis=-1)
    total = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    record, first = p.at(np.arange(p.ends[-1]))
    last = np.minimum(first + length, total.shape[1]) - 1
    amplitude = np.sqrt((total[record, last] - total[record, first]) / np.maximum(last - first, 1))
    drawn = np.maximum(amplitude, 1e-3 * amplitude.max() + 1e-12) ** -power
    return p._replace(share=np.asarray(np.cumsum(drawn / drawn.sum()), np.float32))


def random_chunks(p: Places, length: int, count: int | None, key: AnyArray) -> SegmentBatch:
    """Draw `count` chunks of `length` samples with JAX; None: as many as cover the records once,
    but at most 128."""
    import jax

    length = min(length, p.u.shape[1])
    if count is None:
        count = max(1, min(128, p.u.shape[0] * p.u.shape[1] // length))
    if p.share is None:
        picked = jax.random.randint(key, (count,), 0, p.ends[-1])
    else:
        at = jax.numpy.searchsorted(p.share, jax.random.uniform(key, (count,)))
        picked = jax.numpy.minimum(at, p.ends[-1] - 1)
    record, first = p.at(picked)

    def cut(values: AnyArray, samples: int) -> AnyArray:
        """Cut the chunk itself: a cut of a whole record would copy that for each chunk."""
        size = (1, samples, *values.shape[2:])

        def one(record: AnyArray, first: AnyArray) -> AnyArray:
            start = (record, first, *[0] * (values.ndim - 2))
            return jax.lax.dynamic_slice(values, start, size)[0]

        return jax.vmap(one)(record, first)

    total = p.u.shape[1]
    past = (cut(values, values.shape[1] - total) for values in (p.past_u, p.past_y))
    return SegmentBatch(flat_past(*past), *(cut(v, length) for v in (p.u, p.y, p.weight)))
