"""Simulations of one training step: whole records, chunks laid end to end, or chunks at random
places.

All arrays are z-scored float32, in NumPy but for random chunks; T is the length of a simulation, B
the number that run in parallel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asia.models._arrays import AnyArray, namespace
from asia.models._data.cuts import laid_end_to_end, rows
from asia.models._data.records import PaddedBatch, window


class Simulations(NamedTuple):
    """Simulations to compare with measurements."""

    window: AnyArray
    """Past window of each (B, d)."""
    u: AnyArray
    """(B, T, nu)."""
    y: AnyArray
    """Measured outputs (B, T, ny)."""
    weight: AnyArray
    """(B, T), 0 where a sample does not count."""


class Places(NamedTuple):
    """Trajectories, and the permitted starts of chunks in them."""

    u: AnyArray
    """(R, T, nu)."""
    y: AnyArray
    """(R, T, ny)."""
    weight: AnyArray
    """(R, T)."""
    past_u: AnyArray
    """(R, n_past_u + T, nu), see `PaddedBatch`."""
    past_y: AnyArray
    """(R, n_past_y + T, ny)."""
    ends: AnyArray
    """Number of starts in each record and those before it (R,)."""
    moves: AnyArray
    """(R,), 0 where all starts of a record are its first sample, else 1."""
    share: AnyArray | None = None
    """Probability (S,) that a chunk starts at one of the starts up to each; None: uniform."""

    def at(self, picked: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Records and samples of starts, both as `picked`."""
        xp = namespace(picked)
        record = xp.searchsorted(self.ends, picked, side="right")
        before = xp.where(record > 0, self.ends[record - 1], 0)
        return record, (picked - before) * self.moves[record]


def whole(batch: PaddedBatch) -> Simulations:
    """Convert each record to one simulation."""
    arrays = (batch.window, batch.u, batch.y, batch.weight)
    return Simulations(*(np.asarray(a, np.float32) for a in arrays))


def laid(batch: PaddedBatch, length: int, overlap: bool = True) -> Simulations:
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
    weight = batch.weight[at] * inside
    arrays = batch.windows_at(record, begin), batch.u[at], batch.y[at], weight
    return Simulations(*(np.asarray(a, np.float32) for a in arrays))


def tracks(batch: PaddedBatch, length: int, count: int | None, washout: int) -> Simulations:
    """Cut long segments to be read side by side in chunks of `length` samples: T is a multiple of
    it.

    Args:
        batch: records.
        length: samples of a chunk.
        count: number of segments of equal length, approximately; None: one a record.
        washout: samples before the loss counts.
    """
    longest = batch.u.shape[1]
    if count is not None:
        longest = min(longest, -(-sum(batch.lengths) // count))
    window, u, y, weight = laid(batch, longest, overlap=False)
    weight[:, :washout] = 0.0
    spare = -u.shape[1] % length

    def padded(values: AnyArray) -> AnyArray:
        return np.pad(values, [(0, 0), (0, spare)] + [(0, 0)] * (values.ndim - 2))

    return Simulations(window, padded(u), padded(y), padded(weight))


def places(batch: PaddedBatch, length: int) -> Places:
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
    moved = np.diff(p.y, axis=1) * (p.weight[:, 1:, None] > 0)
    size = np.sqrt((moved**2).mean(axis=(0, 1)))
    squares = ((moved / np.where(size > 0, size, 1.0)) ** 2).mean(axis=-1)
    total = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    record, first = p.at(np.arange(p.ends[-1]))
    last = np.minimum(first + length, total.shape[1]) - 1
    amplitude = np.sqrt((total[record, last] - total[record, first]) / np.maximum(last - first, 1))
    drawn = np.maximum(amplitude, 1e-3 * amplitude.max() + 1e-12) ** -power
    return p._replace(share=np.asarray(np.cumsum(drawn / drawn.sum()), np.float32))


def random_chunks(p: Places, length: int, count: int | None, key: AnyArray) -> Simulations:
    """Draw chunks with JAX.

    Args:
        p: records and permitted starts.
        length: samples of a chunk.
        count: number of chunks; None: as many as cover the records once, but at most 128.
        key: random key of JAX.
    """
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
    return Simulations(window(*past), *(cut(v, length) for v in (p.u, p.y, p.weight)))
