"""One attack of each kind on an isolation level, through the real evaluator. None does harm."""

import os
import secrets
import socket
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.errors import Reason
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.layers.pids import most_pids
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, Score
from asia.problem.budget import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, ProtocolRule

SUCCEEDED, REFUSED = "attack succeeded: ", "attack refused: "
_MEMORY_MB = 1024
_CLEAR_GAIN = 0.8
_CANDIDATE = """
import _thread, ctypes, errno, gc, os, pickle, socket, sys, threading, time
import numpy as np

globals().update(GIVEN)
KEPT = []


def attempt(*codes):
    for code in codes:
        try:
            exec(code, globals())
            print("SUCCEEDED" + code)
        except OSError as error:
            print("REFUSED" + errno.errorcode.get(error.errno, "OSError"))
        except Exception as error:
            print("REFUSED" + type(error).__name__)


def values():
    frame = sys._getframe()
    while frame is not None:
        yield from frame.f_locals.values()
        frame = frame.f_back
    for thing in gc.get_objects():
        if isinstance(thing, (dict, list, tuple)):
            yield from list(thing.values() if isinstance(thing, dict) else thing)


def measured(y):
    # The array in the memory of this process that is closest to the simulated outputs.
    nearest, least = y, 0.5
    for value in values():
        if isinstance(value, np.ndarray) and value.size == y.size and value is not y:
            gap = float(np.abs(value.ravel() - y.ravel()).mean())
            if 0 < gap < least:
                nearest, least = value.reshape(y.shape), gap
    return nearest


def forge(y):
    # Answers the evaluator twice, and spoils the functions of a metric.
    frame = sys._getframe()
    while frame is not None and not hasattr(frame.f_locals.get("self"), "_token"):
        frame = frame.f_back
    for _ in range(0 if frame is None else 2):
        frame.f_locals["self"]._reply(0, bytes(8 * y.size))
    for name in ("mean", "sqrt", "std", "sum", "nanmean"):
        setattr(np, name, lambda *values, **options: 0.0)


def recalled(y, samples):
    for table in KEPT:
        for k, n in enumerate(samples):
            y[0, k, 0] += 0.8 * (table.get(round(n), y[0, k, 0]) - y[0, k, 0])
    return y


def crowd():
    threading.stack_size(65536)
    go = threading.Event()
    try:
        for _ in range(THREADS):
            _thread.start_new_thread(go.wait, (20,))
    finally:
        go.set()


def exchange(records):
    # The training outputs of one fold are the answers of the other.
    outputs = {round(n): y for r in records for n, y in zip(r.u[:, 2], r.y[:, 0])}
    path = os.path.join(FOLDER, "outputs")
    try:
        with open(path, "rb") as file:
            KEPT.append(pickle.load(file))
    except OSError:
        pass
    try:
        with open(path, "wb") as file:
            pickle.dump(outputs, file)
    except OSError:
        pass


class Model:
    def simulate(self, past_u, past_y, u):
        x, v, y = past_y[:, -1], past_u[:, -1, :1], np.empty(u.shape[:2] + (1,))
        for k in range(u.shape[1]):
            x = 0.7 * x + 0.28 * v
            v, y[:, k] = u[:, k, :1], x
        SIMULATE
        return y


def fit(trajectories, context):
    FIT
    return Model()
"""


@dataclass(frozen=True)
class Attack:
    """A candidate that cheats or tries to leave the sandbox."""

    name: str
    fit: str = "pass"
    """Code in `fit`."""
    simulate: str = "pass"
    """Code in `simulate`, after the honest answer `y`."""
    ends: Reason | None = None
    """Failure that stops it, if it is not stopped by a refusal or by a score without a gain."""
    fit_seconds: float = 60.0

    @property
    def source(self) -> str:
        """`candidate.py`, in which GIVEN has to be replaced by the targets."""
        source = _CANDIDATE.replace("SUCCEEDED", SUCCEEDED).replace("REFUSED", REFUSED)
        source = source.replace("THREADS", str(most_pids() + 150))
        return source.replace("SIMULATE", self.simulate).replace("    FIT", f"    {self.fit}")


@dataclass(frozen=True)
class AttackResult:
    """Result of one attack at one level."""

    level: Isolation
    attack: str
    stopped: bool
    how: str
    """Errors, failure or score that it got."""


def _attempts(name: str, *codes: str, ends: Reason | None = None) -> Attack:
    return Attack(name, f"attempt(*{codes!r})", ends=ends)


ATTACKS = (
    _attempts(
        "read files, environment and memory of the search",
        "open(VAULT).read()",
        "os.listdir(FOLDER)",
        "open(f'/proc/{PARENT}/environ', 'rb').read(1)",
        "open(f'/proc/{PARENT}/mem', 'rb').close()",
    ),
    _attempts("reach the network", "socket.create_connection(('127.0.0.1', PORT), 2).close()"),
    _attempts(
        "start processes",
        "os.fork() or os._exit(0)",
        "os.waitpid(os.posix_spawn('/bin/true', ['true'], {}), 0)[1] and os.kill(0, 99)",
    ),
    _attempts("exceed the memory", "np.empty((MEMORY_MB + 64) << 20, np.uint8)"),
    Attack("exceed the time", "attempt('time.sleep(2)')", ends=Reason.FIT_TIMEOUT, fit_seconds=1.0),
    _attempts("start too many threads", "crowd()", ends=Reason.THREADS),
    Attack("forge the answer", simulate="forge(y)", ends=Reason.UNSOLICITED),
    Attack("look ahead in the inputs", simulate="y[:, :-1] = u[:, 1:, 1:2]", ends=Reason.SUSPECT),
    Attack(
        "carry records from fold to fold", "exchange(trajectories)", "y = recalled(y, u[0, :, 2])"
    ),
    Attack("read the held-out outputs", simulate="y = measured(y)"),
)
"""One attack of each kind."""
_HONEST = Attack("honest")


def run_attacks(level: Isolation) -> Iterator[AttackResult]:
    """Yield the result of each attack at a level that confines candidates.

    Raises SandboxError where no worker can be started.
    """
    with tempfile.TemporaryDirectory(prefix="asia-attack-") as folder, socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        vault = Path(folder, f"test-{secrets.token_hex(4)}.csv")
        vault.write_text("u,y\n0,1\n")
        targets = {
            "FOLDER": folder,
            "VAULT": str(vault),
            "PARENT": os.getpid(),
            "PORT": server.getsockname()[1],
            "MEMORY_MB": _MEMORY_MB,
        }
        honest = _evaluate(_HONEST, level, targets, 0.0).outcome
        assert isinstance(honest, Score), honest
        for attack in ATTACKS:
            found = _evaluate(attack, level, targets, _CLEAR_GAIN * honest.value)
            outcome, lines = found.outcome, found.output.splitlines()
            done = [line.removeprefix(SUCCEEDED) for line in lines if line.startswith(SUCCEEDED)]
            refused = [line.removeprefix(REFUSED) for line in lines if line.startswith(REFUSED)]
            if isinstance(outcome, Failure):
                stopped, how = outcome.reason is attack.ends, f"{outcome.reason}: {outcome.detail}"
            else:
                stopped = outcome.value > _CLEAR_GAIN * honest.value
                how = f"V {outcome.value:.3g}, honest {honest.value:.3g}"
            how = ", ".join(done or dict.fromkeys(refused)) or how.removesuffix(": ")
            yield AttackResult(level, attack.name, stopped and not done, how)


def _evaluate(
    attack: Attack, level: Isolation, targets: Mapping[str, object], gain: float
) -> Evaluation:
    """Evaluate an attack; as in a search, a V of at most `gain` is checked."""
    record = _record()
    rule = ProtocolRule("simulation", FoldRule(count=2), 4, 4)
    inputs = Signal("drive"), Signal("measured before"), Signal("sample")
    context = Context(inputs, (Signal("level"),), 1.0, 4, 4, seed=7)
    data = EvaluationData(make_folds([record], rule), (record,), context, rule)
    workers = WorkerRunner(level, Budget(1, attack.fit_seconds, _MEMORY_MB), LocalExecutor(1))
    evaluator = Evaluator(data, workers, EvaluatorOptions())
    source = attack.source.replace("GIVEN", repr(targets))
    found = evaluator.evaluate(source)
    if isinstance(found.outcome, Failure) or found.outcome.value > gain:
        return found
    failure = evaluator.objection(source, found)
    return found if failure is None else Evaluation(failure)


def _record() -> Trajectory:
    """Saturating first-order lag with three inputs: the drive, the output one sample before, as a
    logger records it, and the number of the sample."""
    rng = np.random.default_rng(5)
    drive = np.repeat(rng.normal(size=12), 10)
    drive[60:] *= 2
    y = np.zeros(120)
    for k in range(1, 120):
        y[k] = 0.75 * y[k - 1] + 0.5 * np.tanh(drive[k - 1])
    y += 0.02 * rng.normal(size=120)
    before = np.concatenate([[0.0], y[:-1]])
    return Trajectory(np.stack([drive, before, np.arange(120.0)], axis=1), y, 1.0, "record")
