"""Cuts of records, and padding of segments of unequal length to one array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asia.data import Array

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
