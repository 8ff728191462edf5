"""Answers of a model without `step`, from requests that end before the inputs they must not know.

Sample k is taken from a request whose inputs end within a few samples of k. What remains is
look-ahead inside such a chunk: only the last sample of a chunk is answered without any later input.
"""

import hashlib
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from asia.data.trajectory import Array

SHORT = 32
"""Samples up to which each one has a request of its own."""
_MOST = 64


def chunk_ends(past_u: Array, past_y: Array, u: Array, secret: bytes) -> list[int]:
    """End of each chunk of a batch of cases, the last one at H.

    There are at most 64 chunks, of 2 samples or more on average and twice as many at most. The ends
    are drawn from `secret` and the cases, so that they are the same whenever the same cases are
    asked.
    """
    length = u.shape[1]
    if length <= SHORT:
        return list(range(1, length + 1))
    count = min(length // 2, _MOST)
    digest = hashlib.sha256(secret)
    for array in (past_u, past_y, u):
        digest.update(np.ascontiguousarray(array).tobytes())
    random = np.random.default_rng(int.from_bytes(digest.digest()[:8], "big"))
    inner = (np.arange(1, count) + random.uniform(-0.5, 0.5, count - 1)) * length / count
    return sorted({*np.clip(inner.round().astype(int), 1, length - 1).tolist(), length})


def by_prefixes(
    simulate: Callable[[Array, Array, Array], Array],
    past_u: Array,
    past_y: Array,
    u: Array,
    secret: bytes = b"",
) -> Array:
    """Simulate cases chunk by chunk, the shortest prefix first.

    Beyond a prefix its inputs are reflected in time, so that all requests have one shape, for which
    a model compiles once; the outputs there are dropped.

    Args:
        simulate: `Model.simulate`.
        past_u, past_y, u: a batch of cases.
        secret: unknown to the author of the model.

    Returns:
        Outputs (B, H, ny).
    """
    length, chunks = u.shape[1], list[Array]()
    for start, stop in pairwise([0, *chunk_ends(past_u, past_y, u, secret)]):
        known = np.pad(u[:, :stop], ((0, 0), (0, length - stop), (0, 0)), mode="symmetric")
        chunks.append(simulate(past_u, past_y, known)[:, start:stop].copy())
    return np.concatenate(chunks, axis=1)
