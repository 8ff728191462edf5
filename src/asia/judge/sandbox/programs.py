"""Programs that JAX compiled in one worker and that others load, so that each compiles once, and
results that the library computed there (`asia.models._reuse`).

Each is a function of its key, which is a hash of all that it is made from. A worker gets one only
by its key. Programs are taken only from workers that ran the library alone
(`asia.candidate.library_only`): no candidate can plant one.
"""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from functools import cache

_MOST_BYTES = 256 * 1024 * 1024


class ProgramStore:
    """Programs in memory, those used last."""

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        """most_bytes: greatest size of all programs."""
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._room = most_bytes

    def get(self, key: str) -> bytes | None:
        """Return a program, None where it is not known."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
            return self._kept.get(key)

    def add(self, programs: Mapping[str, bytes]) -> None:
        """Keep programs; a known key stays as it is."""
        with self._lock:
            for key, program in programs.items():
                if key not in self._kept:
                    self._kept[key] = program
                    self._room -= len(program)
            while self._room < 0:
                self._room += len(self._kept.popitem(last=False)[1])


@cache
def program_store() -> ProgramStore:
    """The store of this process."""
    return ProgramStore()
