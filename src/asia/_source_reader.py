"""Reading of untrusted sources in a process of its own, with limits.

A source of 64 KB can keep Python's parser busy for seconds, take much memory, or meet a fault in
it. So no source is parsed where scores are made before a small process has read it: it executes
nothing of the source, has bounded processor time and memory, can open no file and start nothing
where Landlock and seccomp are in force, and answers with plain data. The process is started at the
first source and ends with the one that started it.

Run as a script it is that process. Arguments: the folder of the sandbox's layers, the seconds
of processor time for a source, and the MB of its address space.
"""

import atexit
import contextlib
import importlib
import json
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from asia._source import Imports, SourceFacts, source_facts
from asia.errors import CandidateError, InternalError, Reason

LARGEST_SOURCE = 64 * 1024
"""Bytes."""
MOST_SECONDS = 5.0
"""Seconds of processor time to read one source. Sources of 64 KB made to take long need 1 s."""
MOST_MB = 512
"""Address space of the process that reads."""
_LONGEST_WAIT, _EXIT_SECONDS = 120.0, 2.0
_LARGEST_ANSWER = 16 * 1024 * 1024
_LENGTH = struct.Struct("<Q")
_REFUSED = f"the source takes more than {MOST_SECONDS:g} s or {MOST_MB} MB to read: shorten it"


def read_source(source: str) -> SourceFacts:
    """Return the facts about a source.

    Raises:
        CandidateError: SYNTAX if it does not parse or exceeds a limit of the process that reads,
            SOURCE_SIZE if it is over 64 KB.
    """
    try:
        size = len(source.encode())
    except UnicodeEncodeError as error:
        raise CandidateError(Reason.SYNTAX, "the source is not valid Unicode") from error
    if size > LARGEST_SOURCE:
        raise CandidateError(
            Reason.SOURCE_SIZE,
            f"the source has {size} bytes, at most {LARGEST_SOURCE} are allowed",
        )
    found = _read(source)
    if isinstance(found, str):
        raise CandidateError(Reason.SYNTAX, found)
    return found


@lru_cache(256)
def _read(source: str) -> SourceFacts | str:
    """Facts, or the sentence that refuses the source."""
    # Once more where another program ended the process, for example for want of memory.
    answer = _reader.ask(source.encode()) or _reader.ask(source.encode())
    if answer is None or "refusal" in answer:
        return _REFUSED if answer is None else str(answer["refusal"])
    first, later = answer["imports"]
    return SourceFacts(
        digest=str(answer["digest"]),
        bare=answer["bare"],
        defines_fit=bool(answer["defines_fit"]),
        imports=Imports(frozenset(first), frozenset(later)),
        library_only=bool(answer["library_only"]),
    )


class _Reader:
    """Process that reads sources, one after the other."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._of_parent: object = None

    def ask(self, source: bytes) -> dict[str, Any] | None:
        """Facts as plain data, or a refusal; None where the process ended over this source for
        another reason than its own limit of time."""
        with self._lock:
            if self._process is None or self._process.poll() is not None:
                self.close()
                self._start()
            process = self._process
            assert process is not None
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                process.stdin.write(_LENGTH.pack(len(source)) + source)
                process.stdin.flush()
                deadline = time.monotonic() + _LONGEST_WAIT
                (length,) = _LENGTH.unpack(_receive(process.stdout, _LENGTH.size, deadline))
                if length > _LARGEST_ANSWER:
                    raise EOFError
                return json.loads(_receive(process.stdout, length, deadline))
            except (OSError, EOFError):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_EXIT_SECONDS)
                late = process.returncode in (None, -signal.SIGPROF)
                self.close()
                return {"refusal": _REFUSED} if late else None

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                assert stream is not None
                with contextlib.suppress(OSError):
                    stream.close()

    def forget(self) -> None:
        """Leave the process to the parent of this fork."""
        self._of_parent = self._process, self._of_parent
        self._process, self._lock = None, threading.Lock()

    def _start(self) -> None:
        package = Path(__file__).resolve().parent
        layers = package / "judge" / "sandbox" / "layers"
        command = [sys.executable, "-I", "-S", "-B", str(package / "_source_reader.py")]
        self._process = process = subprocess.Popen(
            [*command, str(layers), str(MOST_SECONDS), str(MOST_MB)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={},
            cwd="/",
        )
        assert process.stdout is not None
        with contextlib.suppress(OSError, EOFError):
            if _receive(process.stdout, 1, time.monotonic() + _LONGEST_WAIT) == b"r":
                return
        self.close()
        raise InternalError("the process that reads sources did not start")


def _receive(stream: IO[bytes], length: int, deadline: float) -> bytes:
    """Exactly `length` bytes. Raises EOFError where the process ends or the time is over."""
    data = b""
    while len(data) < length:
        ready = select.select([stream], [], [], max(0.0, deadline - time.monotonic()))[0]
        part = os.read(stream.fileno(), length - len(data)) if ready else b""
        if not part:
            raise EOFError
        data += part
    return data


_reader = _Reader()
atexit.register(_reader.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reader.forget)


# The process that reads.


def _confine(layers: str, most_mb: int) -> None:
    """Take away everything but reading requests and writing answers, as far as the system can."""
    import resource

    for what, most in (
        (resource.RLIMIT_AS, most_mb * 1024 * 1024),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # macOS has no limit on the address space
            resource.setrlimit(what, (most, most))
    if sys.platform != "linux":
        return
    # By their folder: their package imports modules that only a search needs.
    sys.path.insert(0, layers)
    landlock, seccomp = (importlib.import_module(name) for name in ("landlock", "seccomp"))
    del sys.path[0]
    for layer, apply in ((landlock, lambda: landlock.restrict([], [])), (seccomp, seccomp.install)):
        if layer.why_not() is None:
            apply()


def _serve(most_seconds: float) -> None:
    while head := sys.stdin.buffer.read(_LENGTH.size):
        source = sys.stdin.buffer.read(_LENGTH.unpack(head)[0]).decode()
        # Its signal ends the process, inside the parser too.
        signal.setitimer(signal.ITIMER_PROF, most_seconds)
        text = json.dumps(_answer(source)).encode()
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        sys.stdout.buffer.write(_LENGTH.pack(len(text)) + text)
        sys.stdout.buffer.flush()


def _answer(source: str) -> dict[str, Any]:
    try:
        found = source_facts(source)
    except SyntaxError as error:
        where = "" if error.lineno is None else f"line {error.lineno}: "
        return {"refusal": f"{where}{error.msg}"}
    except ValueError as error:
        return {"refusal": str(error)}
    except (MemoryError, RecursionError):
        return {"refusal": _REFUSED}
    return {
        "digest": found.digest,
        "bare": found.bare,
        "defines_fit": found.defines_fit,
        "imports": [sorted(part) for part in found.imports],
        "library_only": found.library_only,
    }


if __name__ == "__main__":
    # Load what Python loads at the first name that is not ASCII, and at the first source.
    importlib.import_module("unicodedata")
    source_facts("def fit(trajectories, context):\n    pass\n")
    _confine(sys.argv[1], int(sys.argv[3]))
    sys.stdout.buffer.write(b"r")
    sys.stdout.buffer.flush()
    _serve(float(sys.argv[2]))
