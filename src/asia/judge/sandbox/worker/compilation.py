"""Programs of JAX's compiler and results of the library's own computations that workers share, and
the time that the compiler takes.

Runs in the worker, where a candidate can change all of it. Modules are prepared when they are
imported, and never imported for it.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import struct
import time
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

_MONITORING, _CACHE = "jax.monitoring", "jax._src.compilation_cache"
_REUSE = "asia.models._reuse"
# What JAX's cache keeps in its module; with another version of JAX there is no cache.
_CACHE_STATE = ("_cache", "_cache_initialized", "_cache_checked", "_cache_used")
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

    def clear(self) -> None:
        """Begin anew."""
        self._spent.clear()
        self._ended.clear()

    def tobytes(self, requests: Sequence[str]) -> bytes:
        """Seconds to trace and to compile in each of these requests, as float64."""
        return b"".join(struct.pack("<2d", *self._spent.get(r, (0.0, 0.0))) for r in requests)


class Programs:
    """Compiled programs, in place of the files in which JAX would cache them, and results of
    `asia.models._reuse`."""

    def __init__(self, find: Callable[[str], bytes | None]) -> None:
        """find: asks for a program by its key."""
        self.made: dict[str, bytes] = {}
        """Those that were made here."""
        self._find = find

    def get(self, key: str) -> bytes | None:
        """As JAX asks its cache."""
        return self.made.get(key) or self._find(key)

    def put(self, key: str, value: bytes) -> None:
        """As JAX tells its cache."""
        self.made[key] = value


class PreparingFinder(importlib.abc.MetaPathFinder):
    """Lets `meter` listen, and JAX and the library use `programs`, as soon as they can."""

    def __init__(self, meter: Meter, programs: Programs) -> None:
        self._after = {_MONITORING: self._listen, _CACHE: self._use, _REUSE: self._offer}
        self._meter, self._programs = meter, programs
        self._finding = False

    def find_spec(
        self, fullname: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return None for every module but three, which the other finders find."""
        after = self._after.get(fullname)
        if after is None or self._finding:
            return None
        self._finding = True
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            self._finding = False
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                after(module)

            loader.exec_module = exec_module
        return spec

    def _listen(self, module: Any) -> None:
        register = getattr(module, "register_event_duration_secs_listener", None)
        if callable(register):
            register(self._meter.heard)

    def _use(self, module: Any) -> None:
        if all(hasattr(module, name) for name in _CACHE_STATE):
            for name in _CACHE_STATE[1:]:
                setattr(module, name, True)
            module._cache = self._programs

    def _offer(self, module: Any) -> None:
        module.store = self._programs
