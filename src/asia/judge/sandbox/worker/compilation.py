"""Time in which JAX traces and compiles in a worker, as reported by JAX; the candidate can change
it.

Runs in the worker. JAX is observed from its import on, and never imported for it.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import struct
import sys
import time
from collections.abc import Sequence
from types import ModuleType
from typing import Any

_LISTENS_FOR = "jax.monitoring"
_TRACE, _COMPILE = 0, 1
_KINDS = {
    "/jax/core/compile/jaxpr_trace_duration": _TRACE,
    "/jax/core/compile/jaxpr_to_mlir_module_duration": _TRACE,
    "/jax/core/compile/backend_compile_duration": _COMPILE,
}
_MOST_REMEMBERED = 1000


class Meter:
    """Adds up durations by request. One that happened inside another one counts once."""

    def __init__(self) -> None:
        self.request = ""
        self._spent: dict[str, list[float]] = {}
        self._ended: list[tuple[float, float]] = []

    def heard(self, event: str, duration: float, **about: Any) -> None:
        """A listener of `jax.monitoring`: `event` ends now and took `duration` seconds."""
        del about
        kind = _KINDS.get(event)
        if kind is None:
            return
        begin, own = time.monotonic() - duration, duration
        while self._ended and self._ended[-1][0] >= begin:
            own -= self._ended.pop()[1]
        self._ended.append((begin, duration))
        del self._ended[:-_MOST_REMEMBERED]
        self._spent.setdefault(self.request, [0.0, 0.0])[kind] += max(0.0, own)

    def tobytes(self, requests: Sequence[str]) -> bytes:
        """Seconds to trace and to compile in each of these requests, as float64."""
        return b"".join(struct.pack("<2d", *self._spent.get(r, (0.0, 0.0))) for r in requests)


class JaxFinder(importlib.abc.MetaPathFinder):
    """Lets `meter` listen as soon as JAX can be listened to."""

    def __init__(self, meter: Meter) -> None:
        self._meter = meter

    def find_spec(
        self, fullname: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return None for every module but one, which the other finders find and the meter
        observes."""
        if fullname != _LISTENS_FOR or self not in sys.meta_path:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                register = getattr(module, "register_event_duration_secs_listener", None)
                if callable(register):
                    register(self._meter.heard)

            loader.exec_module = exec_module
        return spec
