"""A worker as the evaluator sees it: fit, load, simulate, dump."""

from __future__ import annotations

import contextlib
import math
import secrets
import threading
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np

from asia._text import printable
from asia._timer import Activity, Seconds
from asia.candidate import Context, ParameterEstimates, library_only
from asia.data.trajectory import Array, Trajectory
from asia.errors import KNOWN_ERRORS, CandidateError, Reason, SandboxError
from asia.judge.sandbox.layers.pids import PidsCgroup, PidsMechanism, count_tasks, most_pids
from asia.judge.sandbox.programs import ProgramStore
from asia.judge.sandbox.types import (
    Limits,
    ScoreModel,
    ScoreRefusedError,
    WorkerKilledError,
)
from asia.judge.sandbox.worker.closed_loop import BeginPlant, ClosedLoop
from asia.judge.sandbox.worker.figures import (
    ESTIMATES_BYTES,
    PARAMETERS_BYTES,
    unpack_estimates,
    unpack_parameters,
)
from asia.judge.sandbox.worker.prefixes import by_prefixes
from asia.judge.sandbox.worker.process import (
    Channel,
    GoneError,
    Head,
    LateError,
    ResourceWatch,
    UnsolicitedError,
    WorkerClock,
    WorkerProcess,
    peak_memory_mb,
)
from asia.judge.sandbox.worker.wire import (
    COMPILED_BYTES,
    CURVE_ROW_BYTES,
    CURVE_ROWS,
    FRAME_HEAD,
    PROGRAM_BYTES,
    PROGRAM_KEY_BYTES,
    SHAPE_DIMENSIONS,
    TEXT_BYTES,
    TOKEN_BYTES,
    ReplyKind,
    unpacked_programs,
)
from asia.lowering.program import LoweredModel
from asia.lowering.wire import LARGEST_BYTES, FormatError, unpack_for

# Once a worker knows cases, its own words could contain them: only the messages in this module are
# passed on.
_REASONS = {
    ReplyKind.SYNTAX: Reason.SYNTAX,
    ReplyKind.CONTRACT: Reason.CONTRACT,
    ReplyKind.CRASH: Reason.CRASH,
    ReplyKind.EXITED: Reason.EXITED,
    ReplyKind.MEMORY: Reason.MEMORY,
    ReplyKind.SHAPE: Reason.WRONG_LENGTH,
}
_OUT_OF_MEMORY = ("std::bad_alloc", "out of memory", "memory allocation", "cannot allocate memory")
_NO_THREAD = "can't start new thread"
_START_SECONDS = 60.0
_COUNT_SECONDS = 1.0
_LOOK_SECONDS, _LOOK_AT_ONE_SECONDS = 0.2, 0.05
_LAST_WORDS = 1500
# Share of the memory limit up to which a worker is used again.
_RENEWED_SHARE = 0.5


def _failure_words(
    status: ReplyKind, body: bytes, expected: tuple[int, ...], *, private: bool
) -> str:
    """Detail of a failure the worker reported; expected: the shape to name in one; private: whether
    the worker knows cases, and may not speak freely."""
    if status is ReplyKind.SHAPE:
        # Numbers near the expected ones only.
        dimensions = np.frombuffer(body[: len(body) // 8 * 8], dtype="<i8")[:SHAPE_DIMENSIONS]
        likely = {0, 1, *(n + shift for n in expected for shift in (-1, 0, 1))}
        words = ", ".join(str(n) if n in likely else "?" for n in dimensions.tolist())
        return f"got shape ({words}), expected {expected}"
    text = printable(body.decode("utf-8", "replace")).strip()
    if not private:
        return text
    if status is ReplyKind.CONTRACT:
        return "no array of numbers, or no model with simulate"
    return text if text in KNOWN_ERRORS else "an exception of its own"


def _finite(y: Array) -> Array:
    if not np.isfinite(y).all():
        raise CandidateError(Reason.NOT_FINITE)
    return y


class Worker:
    """Worker process inside one isolation level; use it as a context manager.

    Open, use and close it in one thread: when the thread that opened it ends, the worker ends.
    After a CandidateError the process is gone and every further request is a SandboxError, except
    after NOT_FINITE, when it continues. All requests raise CandidateError for a fault of the
    candidate and SandboxError for any other one.
    """

    def __init__(
        self, process: WorkerProcess, limits: Limits, pids: PidsMechanism | None = None
    ) -> None:
        """pids: what limits its threads and processes; None where nothing does."""
        self.printed = ""
        """Text that the candidate printed until its fit ended or failed; later output is dropped,
        because it could contain cases."""
        self.closed_loop: ClosedLoop | None = None
        """Loop in which its controllers are simulated; None for models."""
        self._plant = contextlib.ExitStack()
        self._begin_plant: BeginPlant | None = None
        self.left_behind: int | None = None
        """Process id of a worker that the kernel does not end."""
        self._process = process
        self._limits = limits
        self._channel = Channel(process.pipes, process.running)
        self._clock = WorkerClock(process.find)
        self._closed = False
        self._ending = threading.Lock()
        self._ready = False
        self._started = False
        self._latest = math.inf
        self._loaded_source: str | None = None
        self._ny = 0
        self._model_loaded = False
        self._cases_seen = False
        self._has_steps: bool | None = None
        self._peak_before, self._renewable = 0.0, True
        self._pids_mechanism = pids
        self._pids: PidsCgroup | ResourceWatch | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def fit(
        self,
        source: str,
        trajectories: Sequence[Trajectory],
        context: Context,
        score: ScoreModel | None = None,
        programs: ProgramStore | None = None,
        on_loss: Callable[[float, float], None] | None = None,
        fold_models: Sequence[bytes] = (),
    ) -> tuple[Array, str, float]:
        """Execute the source and call its `fit`. The context's deadline becomes the earlier of
        its own and now + fit_seconds; its `log` is replaced by one that fills the curve,
        its `validation_score` by one that asks `score`, whose time counts as the fit's. JAX loads
        compiled `programs`; those that a source of the library alone compiles are added. `on_loss`
        is called with a step and its loss a few times a second. The context offers `fold_models` of
        the same source, as `dump` gave them.

        Returns:
            step and loss given to `context.log` (n, 2), at most 2000 rows, may hold NaN; the first
            64 KB of stdout and stderr; both as the candidate reports them; wall time of the call in
            seconds, measured outside
        """
        late = Reason.FIT_TIMEOUT
        if context.plant is not None:
            context.plant.unpack()
        self._start()
        deadline = time.monotonic() + self._limits.fit_seconds
        context = replace(context, deadline=min(context.deadline, deadline))
        records = [
            (t.u, t.y, t.sampling_time, t.name, t.missing, t.reference) for t in trajectories
        ]
        # The worker has these functions of its own.
        own = ("log", "validation_score", "fold_models")
        plain = {f.name: getattr(context, f.name) for f in fields(context) if f.name not in own}
        with self._clock.activity(Activity.IMPORT):
            arguments = (source, records, plain, score is not None, tuple(fold_models))
            self._ask("fit", arguments, deadline, late, wanted=(ReplyKind.STARTED,))
        with self._clock.activity(Activity.FIT):
            begin = time.monotonic()
            wanted = (ReplyKind.OK, ReplyKind.PROGRAM, ReplyKind.LOSS)
            wanted = wanted if score is None else (*wanted, ReplyKind.SCORE)
            head = self._head(deadline, late, wanted)
            while head.status is not ReplyKind.OK:
                if head.status is ReplyKind.PROGRAM:
                    self._answer_program(programs, head, deadline)
                elif head.status is ReplyKind.LOSS:
                    if head.length != CURVE_ROW_BYTES:
                        raise self._failure(Reason.UNSOLICITED, "a loss of an impossible size")
                    row = np.frombuffer(self._body(head, deadline, late), "<f8")
                    if on_loss is not None and np.isfinite(row).all():
                        on_loss(float(row[0]), float(row[1]))
                elif score is not None:
                    self._answer(score, self._model_bytes(head, deadline, late), deadline)
                head = self._head(deadline, late, wanted)
            seconds = time.monotonic() - begin
            if head.length > CURVE_ROWS * CURVE_ROW_BYTES or head.length % CURVE_ROW_BYTES:
                raise self._failure(Reason.UNSOLICITED, "a training curve of an impossible size")
            curve = np.frombuffer(self._body(head, deadline, late), "<f8").astype(np.float64)
            self._ny, self._model_loaded = context.ny, True
            self.printed = self._channel.take_output()
            if programs is not None and library_only(source):
                self._take_programs(programs)
            return curve.reshape(-1, 2), self.printed, seconds

    def load(self, source: str, model: bytes, context: Context) -> None:
        """Execute the source and take up the model that `dump` gave, in at most fit_seconds. May
        be called again with another model of the same source, which is executed once."""
        self._cases_seen = True
        if self._closed or self._loaded_source != source:
            self._start()
            self._loaded_source = source
        deadline = min(time.monotonic() + self._limits.fit_seconds, self._latest)
        with self._clock.activity(Activity.IMPORT):
            if self._ask("load", (source, model), deadline, Reason.SIMULATE_TIMEOUT).length:
                raise self._failure(Reason.UNSOLICITED)
        self._ny, self._model_loaded, self._has_steps = context.ny, True, None

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        """Simulate a batch of cases, shapes as in `Model.simulate`; returns (B, H, ny), finite.

        The model receives one input sample at a time and answers it before it receives the next. A
        model without `step` is asked for whole simulations of prefixes. Their ends are drawn from
        `secret`: see `prefixes`.
        """
        deadline = self._begin_cases()
        stepwise = self.has_steps
        with self._clock.activity(Activity.SIMULATE):
            if self.closed_loop is not None:
                return _finite(self._in_closed_loop(self.closed_loop, u, deadline))
            if stepwise:
                return _finite(self._streamed(past_u, past_y, u, deadline))
            whole = partial(self._whole, deadline=deadline)
            return _finite(by_prefixes(whole, past_u, past_y, u, secret))

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """As `simulate`, by the model's own `simulate`: for cases that it was fitted to."""
        return _finite(self.simulate_unchecked(past_u, past_y, u))

    def simulate_unchecked(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """As `simulate_known`, with NaN or infinity where the model diverges."""
        deadline = self._begin_cases()
        with self._clock.activity(Activity.SIMULATE):
            if self.closed_loop is not None:
                return self._in_closed_loop(self.closed_loop, u, deadline)
            return self._whole(past_u, past_y, u, deadline)

    def _in_closed_loop(self, loop: ClosedLoop, u: Array, deadline: float) -> Array:
        """Simulate scenarios (B, H, n) with the controller in this worker; responses (B, H, m)."""
        found: list[Array] = []
        if self._begin_plant is None:
            self._begin_plant = self._plant.enter_context(loop.plant())
        try:
            for outside in u:
                with self.stream(loop.seen, loop.driven, deadline) as ask:
                    found.append(loop.simulate(ask, self._begin_plant, outside))
        except CandidateError:
            self._close_plant()
            raise
        return np.stack(found)

    def _close_plant(self) -> None:
        self._begin_plant = None
        self._plant.close()

    @contextlib.contextmanager
    def stream(
        self, nu: int, ny: int, deadline: float | None = None
    ) -> Generator[Callable[[Array], Array]]:
        """Stream of one case without a past: a function from an input sample (nu,) to the output
        (ny,) of the model. Numbers may be infinite or NaN."""
        deadline = self._begin_cases() if deadline is None else deadline
        late, shape = Reason.SIMULATE_TIMEOUT, (1, ny)
        past = np.zeros((1, 0, nu)), np.zeros((1, 0, ny))
        self._send("stream", (*past, ny), deadline, late)
        frame = bytearray(FRAME_HEAD.size + nu * 8)

        def ask(sample: Array) -> Array:
            answer = np.empty(ny, "<f8")
            frame[FRAME_HEAD.size :] = np.ascontiguousarray(sample, "<f8").data.cast("B")
            with self._channel_errors(late):
                token, room = secrets.token_bytes(TOKEN_BYTES), answer.view(np.uint8).data
                head = self._channel.exchange(frame, token, room, deadline)
                self._check_head(head, deadline, (ReplyKind.OK,), shape)
                if head.length != len(room):
                    raise self._failure(Reason.WRONG_LENGTH, f"expected shape {shape}")
            return answer

        yield ask
        with self._channel_errors(late):
            self._channel.send_frame(frame, deadline, goes_on=False)

    def _begin_cases(self) -> float:
        self._need_model()
        self._cases_seen = True
        return min(time.monotonic() + self._limits.simulate_seconds, self._latest)

    def _whole(self, past_u: Array, past_y: Array, u: Array, deadline: float) -> Array:
        late, shape = Reason.SIMULATE_TIMEOUT, (u.shape[0], u.shape[1], self._ny)
        arguments = (past_u, past_y, u, self._ny)
        head = self._ask("simulate", arguments, deadline, late, expected=shape)
        if head.length != math.prod(shape) * 8:
            raise self._failure(Reason.WRONG_LENGTH, f"expected shape {shape}")
        y = np.empty(shape, "<f8")
        with self._channel_errors(late):
            self._channel.receive_into(y.reshape(-1).view(np.uint8).data, deadline)
        return y

    @property
    def has_steps(self) -> bool:
        """Whether the model can be asked sample by sample."""
        if self._has_steps is None:
            self._has_steps = self._reply("has_steps", (), 1) == b"\1"
        return self._has_steps

    def _streamed(self, past_u: Array, past_y: Array, u: Array, deadline: float) -> Array:
        late, (rows, length, nu) = Reason.SIMULATE_TIMEOUT, u.shape
        shape = rows, self._ny
        self._send("stream", (past_u, past_y, self._ny), deadline, late)
        y = np.empty((length, *shape), "<f8")
        inputs, outputs = np.ascontiguousarray(u.swapaxes(0, 1), "<f8"), y.view(np.uint8)
        frame = bytearray(FRAME_HEAD.size + rows * nu * 8)
        tokens = secrets.token_bytes(TOKEN_BYTES * length)
        with self._channel_errors(late):
            for k in range(length):
                frame[FRAME_HEAD.size :] = inputs[k].data.cast("B")
                token = tokens[TOKEN_BYTES * k : TOKEN_BYTES * (k + 1)]
                answer = outputs[k].data.cast("B")
                head = self._channel.exchange(frame, token, answer, deadline)
                self._check_head(head, deadline, (ReplyKind.OK,), shape)
                if head.length != len(answer):
                    raise self._failure(Reason.WRONG_LENGTH, f"expected shape {shape}")
            self._channel.send_frame(frame, deadline, goes_on=False)
        return y.swapaxes(0, 1)

    def lowered(self, context: Context, parameters: Sequence[str] = ()) -> LoweredModel | str:
        """The model as a program to be printed, or why there is none. parameters: as in
        `asia.lowering.trace.lowered`."""
        sizes = context.n_past_u, context.n_past_y, context.nu, context.ny
        self._renewable = False  # From now on its JAX computes in double precision.
        try:
            reply = self._reply("lower", (*sizes, tuple(parameters)), LARGEST_BYTES)
            return unpack_for(reply, sizes)
        except FormatError as error:
            raise self._failure(Reason.UNSOLICITED, str(error)) from None

    def dump(self) -> bytes:
        """The fitted model as opaque bytes; only a worker that runs the same source reads them."""
        self._need_model()
        late = Reason.FIT_TIMEOUT
        deadline = time.monotonic() + self._limits.fit_seconds
        with self._clock.activity(Activity.FIT):
            return self._model_bytes(self._ask("dump", (), deadline, late), deadline, late)

    def parameters(self) -> tuple[tuple[str, float], ...]:
        """Return the named parameters that the fitted model offers, at most `figures.PARAMETERS`.

        Call it before any case: later output of a model could contain cases.
        """
        body = self._reply_before_cases("parameters", PARAMETERS_BYTES)
        try:
            return unpack_parameters(body)
        except ValueError as error:
            raise self._failure(Reason.UNSOLICITED, str(error)) from None

    def estimates(self) -> ParameterEstimates | None:
        """Return the fitted model's estimates of its parameters and its equations for the records
        of its fit, within fit_seconds; None where it offers none.

        Call it before any case, as `parameters`.
        """
        body = self._reply_before_cases("estimates", ESTIMATES_BYTES)
        try:
            return unpack_estimates(body) if body else None
        except ValueError as error:
            raise self._failure(Reason.UNSOLICITED, str(error)) from None

    def numbers(self) -> int | None:
        """Return the count of the numbers in the fitted model, as the worker reports it; None where
        it cannot be counted. Call it before any case, as `parameters`."""
        body = self._reply_before_cases("numbers", FRAME_HEAD.size)
        return int.from_bytes(body, "little") if body else None

    def compile_seconds(self) -> float:
        """Return JAX's time for tracing and compiling in the fit, as the worker reports it, at most
        the time that the fit took. Call it before any case, as `parameters`."""
        body = self._reply_before_cases("compiled", COMPILED_BYTES)
        if len(body) != COMPILED_BYTES:
            raise self._failure(Reason.UNSOLICITED, "no times of compilation")
        longest = self.spent.get(Activity.FIT, (0.0, 0.0))[0]
        seconds = float(np.frombuffer(body, "<f8")[:2].sum())
        return min(seconds, longest) if seconds > 0 else 0.0

    def _reply_before_cases(self, request: str, most: int) -> bytes:
        if self._cases_seen:
            raise SandboxError(f"the worker has received cases: request {request} before them")
        return self._reply(request, (), most)

    def _reply(self, request: str, arguments: tuple[object, ...], most: int) -> bytes:
        self._need_model()
        late = Reason.FIT_TIMEOUT
        deadline = time.monotonic() + self._limits.fit_seconds
        with self._clock.activity(Activity.FIT):
            head = self._ask(request, arguments, deadline, late)
            if head.length > most:
                raise self._failure(Reason.UNSOLICITED, f"too many bytes of {request}")
            return self._body(head, deadline, late)

    @property
    def peak_memory_mb(self) -> float | None:
        """Largest address space so far, which the limit counts; None where the system does not
        report it, or where an earlier candidate needed more."""
        peak = peak_memory_mb(self._process.find())
        return None if peak is None or peak <= self._peak_before else peak

    @property
    def spent(self) -> Seconds:
        """Seconds of this worker by activity so far; those of JAX are reported by the worker."""
        return self._clock.spent

    def count_compiling(self) -> None:
        """Request JAX's time for tracing and compiling, after all other requests.

        A worker that does not answer at once, or with anything but its numbers, is ignored, and
        ended.
        """
        if self._closed:
            return
        by = time.monotonic() + _COUNT_SECONDS
        try:
            self._channel.send((self._channel.new_token(), "compiled", ()), by)
            if self._channel.receive_head(by) == Head(ReplyKind.OK, COMPILED_BYTES):
                self._clock.count_compiling(self._channel.receive(COMPILED_BYTES, by))
                return
        except (LateError, GoneError, UnsolicitedError):
            pass
        self.close()

    def renew(self) -> bool:
        """Make the worker ready for another source, after one of the library alone; return whether
        it is. Only a source of the library alone may follow: the memory still holds what the first
        one was given."""
        peak = peak_memory_mb(self._process.find())
        small = peak is not None and peak <= _RENEWED_SHARE * self._limits.memory_mb
        if self._closed or not self._renewable or not small:
            return False
        try:
            self._ask("forget", (), time.monotonic() + _START_SECONDS, Reason.FIT_TIMEOUT)
            self._channel.keep_output()
        except (CandidateError, SandboxError):
            return False
        self._clock.restart()
        self.printed, self._peak_before, self._latest = "", peak or 0.0, math.inf
        self._started = self._model_loaded = self._cases_seen = False
        self._loaded_source = self._has_steps = None
        return True

    def answer_by(self, latest: float) -> None:
        """Limit the waiting of all later loads and simulations to this `time.monotonic()` value."""
        self._latest = latest

    def abort(self) -> None:
        """End the process from another thread: the one that uses it then sees it gone. Nothing
        happens once that one ends it: its handles may belong to others by then."""
        with self._ending, contextlib.suppress(OSError):
            if not self._closed:
                self._process.kill()
                self._process.force()

    def close(self) -> None:
        """End the process with everything it started; may be called again. Processes that the
        kernel does not end are `left_behind`."""
        if not self._closed:
            with self._ending:
                self._closed = True
            self._close_plant()
            if isinstance(self._pids, ResourceWatch):
                self._pids.close()
            with self._clock.activity(Activity.START):
                self._channel.close()
                if not self._process.end():
                    self.left_behind = self._process.process.pid
            if isinstance(self._pids, PidsCgroup):
                self._pids.close()

    def wait(self) -> None:
        """Wait until the process is ready, so that its start does not count as fit time.

        Raises:
            SandboxError: when the worker does not start, or has ended while it waited
        """
        if self._ready and self._process.running():
            return
        self._ready = False
        try:
            with self._clock.activity(Activity.START):
                head = self._channel.receive_head(time.monotonic() + _START_SECONDS)
            self._limit_pids()
            self._ready = head == Head(ReplyKind.STARTED, 0)
        except (LateError, GoneError, UnsolicitedError):
            pass
        if not self._ready:
            said = self._channel.take_output()[-500:].strip()
            self.close()
            raise SandboxError(f"a worker did not start: {said or 'no message'}")

    def _limit_pids(self) -> None:
        """Limit the threads and processes, before anything of a candidate runs."""
        match self._pids_mechanism:
            case PidsMechanism.CGROUP:
                try:
                    self._pids = group = PidsCgroup(most_pids())
                    group.add(self._process.find() or 0)
                except OSError as error:
                    self.close()
                    raise SandboxError(
                        f"a worker could not be put into a cgroup: {error}"
                    ) from None
            case PidsMechanism.WATCHER:
                self._pids = ResourceWatch(
                    lambda: count_tasks(self._process.pids()),
                    most_pids(),
                    self.abort,
                    _LOOK_AT_ONE_SECONDS if self._process.guard is None else _LOOK_SECONDS,
                )
            case _:
                pass

    def _start(self) -> None:
        if self._started or self._closed:
            raise SandboxError("a worker takes one fit, or models of one source; open a fresh one")
        self._started = True
        self.wait()

    def _answer(self, score: ScoreModel, model: bytes, deadline: float) -> None:
        """Score a model that the candidate is training. Both processes end with a failure."""
        late = Reason.FIT_TIMEOUT
        try:
            with self._clock.elsewhere(Activity.FIT):
                answer = ("score", (score(model, deadline),))
        except ScoreRefusedError as refused:
            answer = ("refuse", (str(refused),))
        except CandidateError:
            self.close()
            if time.monotonic() >= deadline:
                raise self._translated(LateError(), late) from None
            raise
        self._send(*answer, deadline, late)

    def _answer_program(self, programs: ProgramStore | None, head: Head, deadline: float) -> None:
        """Answer with the program of a key, or none."""
        late = Reason.FIT_TIMEOUT
        if head.length > PROGRAM_KEY_BYTES:
            raise self._failure(Reason.UNSOLICITED, "a key of an impossible size")
        key = self._body(head, deadline, late).decode("ascii", "replace")
        found = None if programs is None else programs.get(key)
        self._send("program", (found,), deadline, late)

    def _take_programs(self, programs: ProgramStore) -> None:
        try:
            programs.add(unpacked_programs(self._reply("programs", (), PROGRAM_BYTES)))
        except ValueError as error:
            raise self._failure(Reason.UNSOLICITED, str(error)) from None

    def _need_model(self) -> None:
        if self._closed or not self._model_loaded:
            raise SandboxError("the worker has no model: call fit or load first")

    @contextlib.contextmanager
    def _channel_errors(self, late: Reason) -> Generator[None]:
        try:
            yield
        except (LateError, GoneError, UnsolicitedError) as error:
            raise self._translated(error, late) from None

    def _send(
        self, name: str, arguments: tuple[object, ...], deadline: float, late: Reason
    ) -> None:
        with self._channel_errors(late):
            self._channel.send((self._channel.new_token(), name, arguments), deadline)

    def _ask(
        self,
        name: str,
        arguments: tuple[object, ...],
        deadline: float,
        late: Reason,
        wanted: tuple[ReplyKind, ...] = (ReplyKind.OK,),
        expected: tuple[int, ...] = (),
    ) -> Head:
        self._send(name, arguments, deadline, late)
        return self._head(deadline, late, wanted, expected)

    def _head(
        self,
        deadline: float,
        late: Reason,
        wanted: tuple[ReplyKind, ...] = (ReplyKind.OK,),
        expected: tuple[int, ...] = (),
    ) -> Head:
        """Head of a reply that is no failure; `expected` is the shape to name in one."""
        with self._channel_errors(late):
            head = self._channel.receive_head(deadline)
            self._check_head(head, deadline, wanted, expected)
            return head

    def _check_head(
        self, head: Head, deadline: float, wanted: tuple[ReplyKind, ...], expected: tuple[int, ...]
    ) -> None:
        if head.status in wanted:
            return
        if head.status not in _REASONS:
            raise UnsolicitedError
        length = head.length if head.length <= TEXT_BYTES else 0
        body = self._channel.receive(length, deadline)
        words = _failure_words(head.status, body, expected, private=self._cases_seen)
        raise self._failure(_REASONS[head.status], words)

    def _model_bytes(self, head: Head, deadline: float, late: Reason) -> bytes:
        if head.length > self._limits.model_mb * 1024 * 1024:
            detail = f"{head.length} bytes, the limit is {self._limits.model_mb} MB"
            raise self._failure(Reason.MODEL_SIZE, detail)
        return self._body(head, deadline, late)

    def _body(self, head: Head, deadline: float, late: Reason) -> bytes:
        with self._channel_errors(late):
            return self._channel.receive(head.length, deadline)

    def _translated(self, error: Exception, late: Reason) -> CandidateError | SandboxError:
        if isinstance(error, LateError):
            seconds = (
                self._limits.simulate_seconds
                if late is Reason.SIMULATE_TIMEOUT and self._model_loaded
                else self._limits.fit_seconds
            )
            return self._failure(late, f"no answer within {seconds:g} s")
        if isinstance(error, UnsolicitedError):
            return self._failure(Reason.UNSOLICITED)
        ending = self._process.ending()
        if isinstance(self._pids, ResourceWatch) and self._pids.exceeded:
            return self._failure(Reason.EXITED)
        if ending.outside is not None:
            self.close()
            number = int(ending.outside)
            return WorkerKilledError(f"another process ended the worker by signal {number}")
        if self._cases_seen:
            return self._failure(Reason.EXITED)
        said = self._channel.take_output()[-_LAST_WORDS:].strip()
        starved = any(words in said.lower() for words in _OUT_OF_MEMORY)
        how = "" if ending.code is None else f"exit code {ending.code}; "
        detail = f"{how}last printed: {said or 'nothing'}"
        return self._failure(Reason.MEMORY if starved else Reason.EXITED, detail)

    def _failure(self, reason: Reason, detail: str = "") -> CandidateError:
        """End the worker; the error is the caller's to raise."""
        crashed = reason in (Reason.CRASH, Reason.EXITED, Reason.MEMORY)
        refused = self._pids_mechanism is not None and _NO_THREAD in detail
        if crashed and (refused or (self._pids is not None and self._pids.exceeded)):
            reason, detail = Reason.THREADS, f"at most {most_pids()} threads and processes"
        if not (self._closed or self._cases_seen or self._model_loaded):
            self.printed = self._channel.take_output()
        self.close()
        return CandidateError(reason, detail)
