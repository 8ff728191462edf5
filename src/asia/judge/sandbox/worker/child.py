"""The worker's own side of the sandbox, and the only file that runs candidate code.

Run as a script in a fresh process; nothing in the parent imports it.
Arguments: request fd, reply fd, memory limit in MB, limit on threads (0 for one that others hold),
the layers it puts on itself (commas between);
how many libraries to load ahead, then these; how many folders to add to the import path, then
these; how many packages to import from a place of their own, then these, each as name=place; the
places it may read.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import linecache
import os
import pickle
import resource
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from asia.candidate import Context, Model
    from asia.data.trajectory import Array, Mask, Trajectory
    from asia.judge.sandbox.layers import lockdown
    from asia.judge.sandbox.worker import compilation, figures, portable, wire
else:
    # Imported by their folders: their package imports modules that only the parent needs.
    _HERE = os.path.dirname(os.path.abspath(__file__))
    sys.path[:0] = [_HERE, os.path.join(os.path.dirname(_HERE), "layers")]
    import compilation
    import figures
    import lockdown
    import portable
    import wire

    del sys.path[:2]

_SOURCE_NAME = "candidate.py"
_LARGEST_FILE = 64 * 1024 * 1024
_OPEN_FILES = 256
_MESSAGE_CHARACTERS = 1000
_SHORT = 4096


def _restrict(memory_mb: int) -> None:
    """Limits on resources, before the system call filter takes away the means to set them."""
    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: _LARGEST_FILE,
        resource.RLIMIT_NOFILE: _OPEN_FILES,
    }
    if sys.platform == "linux":
        limits[resource.RLIMIT_AS] = memory_mb * 1024 * 1024
        limits[resource.RLIMIT_MEMLOCK] = 0
        limits[resource.RLIMIT_MSGQUEUE] = 0
        # Queued signals are counted over all processes of the user.
        limits[resource.RLIMIT_SIGPENDING] = 0
    for what, wanted in limits.items():
        _limit(what, wanted)


def _limit(what: int, wanted: int) -> None:
    hard = resource.getrlimit(what)[1]
    value = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(what, (value, value))


class _PackageFinder(importlib.abc.MetaPathFinder):
    """Finder of packages by their own paths.

    The folders that hold them may not be listed, because a candidate must not see which other
    packages are installed.
    """

    def __init__(self, packages: list[str]) -> None:
        self._places: dict[str, list[str]] = {}
        for word in packages:
            name, _, place = word.partition("=")
            self._places.setdefault(name, []).append(place)

    def find_spec(
        self, fullname: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        places = self._places.get(fullname)
        if places is None:
            return None
        if os.path.isfile(places[0]):
            return importlib.util.spec_from_file_location(fullname, places[0])
        start = os.path.join(places[0], "__init__.py")
        if os.path.isfile(start):
            return importlib.util.spec_from_file_location(
                fullname, start, submodule_search_locations=places
            )
        spec = importlib.machinery.ModuleSpec(fullname, None, is_package=True)
        spec.submodule_search_locations = places
        return spec


class _RefusedError(Exception):
    """The candidate breaks the contract in a way that raised nothing by itself."""


class _WrongShapeError(Exception):
    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = shape


def _execute(source: str) -> ModuleType:
    """Run the source as module `candidate`, so that models pickle by reference to it."""
    module = ModuleType("candidate")
    module.__file__ = _SOURCE_NAME
    sys.modules["candidate"] = module
    lines = source.splitlines(keepends=True)
    linecache.cache[_SOURCE_NAME] = (len(source), None, lines, _SOURCE_NAME)
    exec(compile(source, _SOURCE_NAME, "exec", dont_inherit=True), module.__dict__)
    return module


def _real(result: object, shape: tuple[int, ...]) -> Array:
    """Copy of an answer as float64; refused where it is not one of real numbers in this shape."""
    import numpy as np

    try:
        y = np.array(result, order="C", subok=False)
        if y.dtype.kind not in "biufO":
            raise TypeError("not real numbers")
        y = y.astype("<f8", copy=False)
    except (TypeError, ValueError) as error:
        raise _RefusedError from error
    if y.shape != shape:
        raise _WrongShapeError(y.shape)
    return y


def _as_model(value: object, what: str = "fit returned") -> Model:
    if not callable(getattr(value, "simulate", None)):
        raise _RefusedError(f"{what} {type(value).__name__}, which has no simulate method")
    return value  # pyright: ignore[reportReturnType]


class _TrainingCurve:
    """Training curve of bounded size: thinned by two whenever it is full."""

    def __init__(self, show: Callable[[float, float], None]) -> None:
        """show: called with step and loss, no more often than every `wire.LOSS_SECONDS`."""
        self._show, self._shown = show, -wire.LOSS_SECONDS
        self._stride = 1
        self._calls = 0
        self._kept: list[tuple[float, float]] = []

    def log(self, step: float, loss: float) -> None:
        if self._calls % self._stride == 0:
            if len(self._kept) == wire.CURVE_ROWS:
                self._kept = self._kept[::2]
                self._stride *= 2
            if self._calls % self._stride == 0:
                self._kept.append((float(step), float(loss)))
        self._calls += 1
        if time.monotonic() - self._shown >= wire.LOSS_SECONDS:
            self._shown = time.monotonic()
            self._show(float(step), float(loss))

    def tobytes(self) -> bytes:
        """Steps and losses as float64, row after row."""
        import numpy as np

        return np.array(self._kept, dtype="<f8").tobytes()


class _Session:
    """Session that handles requests until the parent closes the pipe."""

    def __init__(self, requests: int, replies: int, places: tuple[str, ...]) -> None:
        """places: folders of this machine, which no fitted model may name."""
        self._requests = requests
        self._replies = replies
        self._places = places
        self._pid = os.getpid()
        self._token = bytes(wire.TOKEN_BYTES)
        self._model: Model | None = None
        self._fitted_to: tuple[list[Trajectory], Context] | None = None
        self._executed: str | None = None
        self._fitting = False
        self._asking = threading.Lock()
        self._compiling = compilation.Meter()
        self._programs = compilation.Programs(self._program)
        sys.meta_path.insert(0, compilation.PreparingFinder(self._compiling, self._programs))

    def serve(self) -> NoReturn:
        self._reply(wire.ReplyKind.STARTED)
        handlers: dict[str, Callable[..., bytes | memoryview | None]] = {
            "fit": self._fit,
            "load": self._load,
            "simulate": self._simulate,
            "stream": self._stream,
            "has_steps": self._has_steps,
            "dump": lambda: self._pickled(self._model),
            "parameters": self._parameters,
            "numbers": self._numbers,
            "estimates": self._estimates,
            "lower": self._lower,
            "compiled": lambda: self._compiling.tobytes(wire.COMPILED),
            "programs": lambda: wire.packed_programs(self._programs.made),
            "forget": self._forget,
        }
        while True:
            self._token, name, arguments = wire.read_request(self._requests)
            status = wire.ReplyKind.OK
            self._compiling.request = "simulate" if name == "stream" else name
            try:
                body = handlers[name](*arguments)
                arguments = ()
            except BaseException as error:  # noqa: BLE001 - the border to candidate code
                status, body = self._describe(error, private=name in ("load", "simulate", "stream"))
                del error
            if body is not None:
                self._reply(status, body)

    def _reply(self, status: int, body: bytes | memoryview = b"") -> None:
        if os.getpid() != self._pid:
            os._exit(0)  # a fork that strayed out of candidate code
        head = wire.REPLY_HEAD.pack(status, self._token, len(body))
        # A short reply goes at once: the parent waits for it at each step of a simulation.
        parts = (head + body,) if len(body) < _SHORT else (head, body)
        for data in map(memoryview, parts):
            done = 0
            while done < len(data):
                done += os.write(self._replies, data[done:])

    def _fit(
        self,
        source: str,
        records: list[tuple[Array, Array, float, str, Mask | None, Array | None]],
        known: dict[str, Any],
        scored: bool,
        fold_models: Sequence[bytes],
    ) -> bytes:
        import numpy as np

        from asia.candidate import Context
        from asia.data.standardise import standardised
        from asia.data.trajectory import Trajectory

        trajectories: list[Trajectory] = []
        while records:  # each is let go once it is taken over
            u, y, sampling_time, name, missing, reference = records.pop(0)
            # A record may not be written to, so that it takes the array that came, without a copy.
            for values in (u, y):
                place: object = values
                while isinstance(place, np.ndarray):
                    place.setflags(write=False)
                    place = place.base
            trajectories.append(Trajectory(u, y, sampling_time, name, missing, reference))
        module = _execute(source)
        name, first = ("fit", "trajectories") if known["control"] is None else ("design", "models")
        if not callable(getattr(module, name, None)):
            raise _RefusedError(f"the source defines no function {name}({first}, context)")
        fit: Any = getattr(module, name)
        points = _TrainingCurve(self._show_loss)
        validation_score = self._validation_score if scored else None
        context = Context(
            **known, log=points.log, validation_score=validation_score,
            fold_models=lambda: tuple(map(pickle.loads, fold_models)),
        )  # fmt: skip
        if context.control is None:
            trajectories, context, restored = standardised(trajectories, context)
            self._reply(wire.ReplyKind.STARTED)
            self._fitting = True
            self._model = _as_model(restored(fit(trajectories, context)))
        else:
            from asia.models.controllers import controlled

            self._reply(wire.ReplyKind.STARTED)
            self._fitting = True
            self._model = controlled(fit, trajectories, context)
        self._fitting = False
        self._fitted_to = trajectories, context
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        return points.tobytes()

    def _show_loss(self, step: float, loss: float) -> None:
        import numpy as np

        with self._asking:
            if self._fitting and os.getpid() == self._pid:
                self._reply(wire.ReplyKind.LOSS, np.array([step, loss], "<f8").tobytes())

    def _validation_score(self, model: Model) -> float:
        body = self._pickled(_as_model(model, "validation_score was given"))
        with self._asking:
            if not self._fitting:
                raise RuntimeError("validation_score is there for the time of fit only")
            self._reply(wire.ReplyKind.SCORE, body)
            self._token, name, (answer,) = wire.read_request(self._requests)
        if name == "refuse":
            raise RuntimeError(answer)
        return answer

    def _program(self, key: str) -> bytes | None:
        """A compiled program that the parent knows, during a fit."""
        with self._asking:
            if not self._fitting or os.getpid() != self._pid:
                return None
            self._reply(wire.ReplyKind.PROGRAM, key.encode())
            self._token, _, (program,) = wire.read_request(self._requests)
        return program

    def _load(self, source: str, model: bytes) -> bytes:
        """Load a model; the source runs once, so that compiled code serves the next model too."""
        if source != self._executed:
            _execute(source)
            self._executed = source
        self._model = _as_model(pickle.loads(model))
        return b""

    def _forget(self) -> bytes:
        """Drop source, model and records, so that another source of the library alone follows."""
        self._model = self._fitted_to = self._executed = None
        sys.modules.pop("candidate", None)
        linecache.cache.pop(_SOURCE_NAME, None)
        self._compiling.clear()
        self._programs.made.clear()
        gc.collect()
        return b""

    def _simulate(self, past_u: Array, past_y: Array, u: Array, ny: int) -> memoryview:
        import numpy as np

        assert self._model is not None
        y = _real(self._model.simulate(past_u, past_y, u), (u.shape[0], u.shape[1], ny))
        return y.reshape(-1).view(np.uint8).data

    def _has_steps(self) -> bytes:
        names = ("initial", "step")
        return bytes([all(callable(getattr(self._model, name, None)) for name in names)])

    def _stream(self, past_u: Array, past_y: Array, ny: int) -> None:
        """Answer frames of one input sample until an empty one. How many samples are to come is not
        known here."""
        import numpy as np

        model: Any = self._model
        (rows, _, nu), begun, state = past_u.shape, False, None
        frame = bytearray(wire.FRAME_HEAD.size + rows * nu * 8)
        sample = np.frombuffer(frame, "<f8", rows * nu, wire.FRAME_HEAD.size).reshape(rows, nu)
        while True:
            wire.read_into(self._requests, memoryview(frame))
            self._token, goes_on = wire.FRAME_HEAD.unpack_from(frame)
            if not goes_on:
                return
            u = sample.copy()
            if not begun:
                begun, state = True, model.initial(past_u, past_y, u)
            state, y = model.step(state, u)
            self._reply(wire.ReplyKind.OK, _real(y, (rows, ny)).tobytes())

    def _lower(
        self, n_past_u: int, n_past_y: int, nu: int, ny: int, parameters: tuple[str, ...]
    ) -> bytes:
        """Traced here, where the model's own code may run."""
        from asia.lowering.trace import lowered_bytes

        return lowered_bytes(self._model, n_past_u, n_past_y, nu, ny, parameters)

    def _parameters(self) -> bytes:
        """Those that the model names. They are evidence and no part of the contract: a model
        without them, or with something else of that name, is none the worse."""
        offered = getattr(self._model, "parameters", None)
        try:
            return figures.pack_parameters(offered() if callable(offered) else offered)
        except Exception:  # noqa: BLE001 - the border to candidate code
            return b""

    def _numbers(self) -> bytes:
        """Count of the numbers in the fitted model; nothing where it cannot be counted."""
        try:
            return figures.count_numbers(self._model, {}).to_bytes(8, "little")
        except Exception:  # noqa: BLE001 - the border to candidate code
            return b""

    def _estimates(self) -> bytes:
        """Return the model's parameter estimates for its training records, or its values alone with
        the reason; nothing where it has no such method."""
        offered = getattr(self._model, "estimates", None)
        try:
            assert callable(offered)
            assert self._fitted_to is not None
            try:
                return figures.pack_estimates(offered(*self._fitted_to))
            except Exception as error:  # noqa: BLE001 - the border to candidate code
                return figures.pack_values(self._model, str(error) or type(error).__name__)
        except Exception:  # noqa: BLE001 - the border to candidate code
            return b""

    def _pickled(self, model: object) -> bytes:
        import cloudpickle

        try:
            return portable.portable(cloudpickle.dumps(model, protocol=5), self._places)
        except portable.PlaceError:
            raise _RefusedError(
                "the fitted model holds bytes that name a folder of this machine, so it could not "
                "be published: keep no path, and no compiled program, in the model"
            ) from None

    def _describe(self, error: BaseException, *, private: bool) -> tuple[int, bytes]:
        """ReplyKind and words for an error; `private` gives away the class name only."""
        status = wire.ReplyKind
        if isinstance(error, _WrongShapeError):
            import numpy as np

            dimensions = error.shape[: wire.SHAPE_DIMENSIONS]
            return status.SHAPE, np.array(dimensions, dtype="<i8").tobytes()
        kind = status.CRASH
        if isinstance(error, _RefusedError):
            kind = status.CONTRACT
        elif isinstance(error, SystemExit):
            kind = status.EXITED
        elif isinstance(error, SyntaxError) and error.filename == _SOURCE_NAME:
            kind = status.SYNTAX
        elif isinstance(error, MemoryError):
            kind = status.MEMORY
        else:
            with contextlib.suppress(BaseException):
                start = str(error)[:500]
                if "RESOURCE_EXHAUSTED" in start or "Cannot allocate memory" in start:
                    kind = status.MEMORY
        if private:
            return kind, type(error).__name__.encode("ascii", "replace")[:100]
        try:
            text = str(error) if isinstance(error, _RefusedError) else _candidate_traceback(error)
        except BaseException:  # noqa: BLE001 - out of memory, or a __str__ that raises
            text = type(error).__name__
        return kind, text.encode("utf-8", "replace")[-wire.TEXT_BYTES :]


def _candidate_traceback(error: BaseException) -> str:
    """Return the candidate's own frames and the last two of its callees, then the message."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [place for place, frame in enumerate(frames) if frame.filename == _SOURCE_NAME]
    kept = [
        frame
        for place, frame in enumerate(frames)
        if place in own or (own and place > own[0] and place >= len(frames) - 2)
    ]
    message = "".join(traceback.format_exception_only(error))
    if len(message) > _MESSAGE_CHARACTERS:
        message = message[:_MESSAGE_CHARACTERS] + " ..."
    return "".join(traceback.format_list(kept)) + message


def main(arguments: list[str]) -> NoReturn:
    requests, replies, memory_mb, pids = (int(word) for word in arguments[:4])
    layers = arguments[4].split(",")
    readable = arguments[5:]

    def counted() -> list[str]:
        """Take a list that is preceded by its length from the remaining words."""
        count = int(readable.pop(0))
        taken, readable[:] = readable[:count], readable[count:]
        return taken

    libraries, folders, packages = counted(), counted(), counted()
    if lockdown.RLIMITS in layers:
        _restrict(memory_mb)
    if pids:
        _limit(resource.RLIMIT_NPROC, pids)
    # Before numpy, whose threads Landlock would not bind.
    lockdown.confine(layers, readable)
    sys.path.extend(folder for folder in folders if folder not in sys.path)
    sys.meta_path.insert(0, _PackageFinder(packages))
    for fd in (requests, replies):
        os.set_inheritable(fd, False)
    places = portable.places_here(word.partition("=")[2] for word in packages)
    session = _Session(requests, replies, places)
    # Now, off the clock of the first request.
    for name in ("asia.candidate", *libraries):
        importlib.import_module(name)
    session.serve()


if __name__ == "__main__":
    main(sys.argv[1:])
