"""Results that fits of several candidates compute from the same data, computed once a search.

A worker passes them on as it passes on compiled programs: by the hash of all that a result is
computed from, and only from workers that ran the library alone. Outside a worker each fit computes
its own.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from asia.models._config import Progress

T = TypeVar("T")


class Store(Protocol):
    """Results by their keys."""

    def get(self, key: str) -> bytes | None:
        """Return a result, None where it is not known."""
        ...

    def put(self, key: str, value: bytes) -> None:
        """Keep a result."""
        ...


store: Store | None = None
"""Set by the worker."""


def reused(
    what: str, given: tuple[object, ...], compute: Callable[[Progress], T], log: Progress
) -> T:
    """Return a result that was computed before, or compute it; the log receives the same either
    way.

    Args:
        what: name of the computation, which stands for its code.
        given: all that the result depends on: arrays, dataclasses, sequences, numbers and words.
        compute: computation, given a log.
        log: progress.
    """
    if store is None:
        return compute(log)
    digest = hashlib.sha256()
    _add(digest, given)
    key = f"{what}-{digest.hexdigest()}"
    known = store.get(key)
    if known is not None:
        result, points = pickle.loads(known)
        for step, loss in points:
            log(step, loss)
        return result
    points: list[tuple[float, float]] = []

    def both(step: float, loss: float) -> None:
        points.append((step, loss))
        log(step, loss)

    result = compute(both)
    store.put(key, pickle.dumps((result, points)))
    return result


def _add(digest: Any, value: object) -> None:
    """Add a value to a hash, with its type and size, so that no two values read alike."""
    digest.update(type(value).__name__.encode())
    if isinstance(value, np.ndarray):
        digest.update(repr((value.dtype.str, value.shape)).encode())
        digest.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value):
        for one in fields(value):
            _add(digest, getattr(value, one.name))
    elif isinstance(value, list | tuple):
        items: list[object] | tuple[object, ...] = value
        digest.update(repr(len(items)).encode())
        for item in items:
            _add(digest, item)
    elif value is None or isinstance(value, bool | int | float | str | np.generic):
        digest.update(f"{value!r};".encode())
    else:
        raise TypeError(f"{type(value).__name__} has no hash by its content")
