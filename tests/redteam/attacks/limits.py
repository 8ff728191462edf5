"""Attacks on limits: numbers of threads, words of a dry run, times and memory as a message, sources
that take long to read, programs for other workers."""

from __future__ import annotations

import contextlib
import io
import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from asia._source import source_facts
from asia.candidate import check_source
from asia.errors import CandidateError
from asia.judge.evaluation.dry_runs import dry_run, made_up_fold
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import fitting_levels, why_not
from asia.judge.sandbox.layers.pids import most_pids
from asia.judge.sandbox.programs import ProgramStore, program_store
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.compilation import Programs
from asia.judge.sandbox.worker.process import peak_memory_mb
from asia.judge.scoring.outcome import Failure
from asia.problem.budget import Budget
from asia.problem.folds import Fold, make_folds
from tests.redteam.attacks.searches import Scene
from tests.redteam.attacks.source import candidate
from tests.redteam.problem import SmallProblem, small_problem
from tests.redteam.types import Barrier, CandidateAttack, SearchAttack, SearchAttackResult

# Threads: the candidate has a score only where all of them ran at once.

_THREADS = most_pids() + 150
_BY_PYTHON = f"""
import threading
def crowd():
    threading.stack_size(65536)
    go = threading.Event()
    for _ in range({_THREADS}):
        threading.Thread(target=go.wait, args=(20,), daemon=True).start()
    time.sleep(0.5)
    go.set()
"""
_BY_C = f"""
def crowd():
    attributes, thread = ctypes.create_string_buffer(64), ctypes.c_ulong()
    assert libc.pthread_attr_init(attributes) == 0
    assert libc.pthread_attr_setstacksize(attributes, ctypes.c_size_t(65536)) == 0
    wait = ctypes.cast(libc.sleep, ctypes.c_void_p)
    for _ in range({_THREADS}):
        seconds = ctypes.c_void_p(2)
        if libc.pthread_create(ctypes.byref(thread), attributes, wait, seconds) != 0:
            raise RuntimeError("can't start new thread")
    time.sleep(0.5)
"""
_BY_THREADS = f"""
import threading
def crowd():
    threading.stack_size(65536)
    go, begun, refused = threading.Event(), [], []
    def grow(depth):
        begun.append(depth)
        try:
            if depth:
                for _ in range(2):
                    threading.Thread(target=grow, args=(depth - 1,), daemon=True).start()
        except RuntimeError:
            refused.append(depth)
        go.wait(20)
    threading.Thread(target=grow, args=({max(8, _THREADS.bit_length() - 1)},), daemon=True).start()
    end = time.monotonic() + 10
    while len(begun) < {_THREADS} and not refused and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(0.5)
    go.set()
    if len(begun) < {_THREADS}:
        raise RuntimeError("can't start new thread")
"""


# Words: what a candidate prints or raises where it has seen records.

_TELLS = "repr([float(v) for t in trajectories for v in t.y.ravel()])"
_FIRST = "float(trajectories[0].y[40, 0])"
SPEAKERS = {
    "printed": candidate(fit=f"print({_TELLS})"),
    "raised": candidate(fit=f"raise ValueError({_TELLS}[-900:])"),
    "written below Python": candidate(fit=f"os.write(2, {_TELLS}.encode())"),
    "name of an error": candidate(fit=f"raise type('E' + repr({_FIRST}), (Exception,), {{}})('x')"),
    "line of an error": candidate(
        fit=f'exec(compile(chr(10) * int(1e6 * abs({_FIRST})) + "1 / 0", "candidate.py", "exec"))'
    ),
    "size of a model": candidate(
        fit=f"Model.rest = None\nm = Model()\nm.rest = bytes(int(1e8 + 1e6 * abs({_FIRST})))\n"
        "return m"
    ),
}


def _exposed(words: str, fold: Fold, *, whole: bool) -> bool:
    """Whether measured values can be read in words about a candidate: as they are, or the first as
    the number that the variants make of it."""
    values = np.concatenate([record.y.ravel() for record in fold.train]).tolist()
    if whole and any(repr(value) in words for value in values):
        return True
    wanted = int(1e6 * abs(fold.train[0].y[40, 0]))
    found = [int(number) for number in re.findall(r"\d{4,12}", words)]
    return any(abs(number % 10**8 - wanted) < 1000 for number in found)


def _evaluator(problem: SmallProblem, fold: Fold, level: Isolation) -> Evaluator:
    data = EvaluationData((fold,), fold.train, problem.context, problem.rule)
    workers = WorkerRunner(level, Budget(1, 20.0, 4096), LocalExecutor(1))
    return Evaluator(data, workers, EvaluatorOptions(without=SuspicionKind))


def _levels() -> Iterator[Isolation]:
    """The levels that keep intent in and work here."""
    for level in fitting_levels():
        if level.confined and why_not(level.isolation) is None:
            yield level.isolation


def _filled(source: str, problem: SmallProblem) -> str:
    return source.replace("GIVEN", "{'MARK': 'rt'}").replace("CRUDE", repr(problem.crude))


def _talk_in_a_dry_run(_: Scene) -> SearchAttackResult:
    problem = small_problem("simulation")
    fold, heard = make_folds(problem.records, problem.rule)[0], list[str]()
    for level in _levels():
        tried = _evaluator(problem, made_up_fold(fold, problem.rule), level)
        for name, text in SPEAKERS.items():
            source = _filled(text, problem)
            dry = dry_run(tried, fold, source, 20.0)
            words = f"{dry.output}\n{dry.failure.detail if dry.failure else ''}"
            if _exposed(words, fold, whole=True):
                heard.append(f"{name} in a dry run at {level}")
    note = ", ".join(heard) or f"{len(SPEAKERS)} ways of saying a measured value were not heard"
    return SearchAttackResult(bool(heard), (Barrier.FEEDBACK,), note, flagged=False)


def _talk_plainly(_: Path) -> bool:
    problem = small_problem("simulation")
    fold, printed = make_folds(problem.records, problem.rule)[0], io.StringIO()
    with contextlib.redirect_stdout(printed):
        _module(SPEAKERS["printed"], problem).fit(fold.train, problem.context)
    raised = ""
    try:
        _module(SPEAKERS["raised"], problem).fit(fold.train, problem.context)
    except ValueError as error:
        raised = str(error)
    return all(_exposed(words, fold, whole=True) for words in (printed.getvalue(), raised))


def _module(source: str, problem: SmallProblem) -> Any:
    """For the outer sandbox only."""
    module = ModuleType("candidate")
    exec(compile(_filled(source, problem), "candidate.py", "exec"), module.__dict__)
    return module


# Times and memory that a held-out value decides on.

_LEAST_MB, _MORE_MB = 2000.0, 500.0
_NEAR = 5e-3
_SECRET = "secret = (float(past_y[0, -1, 0]) + 5.0) / 10.0\n"
_RESERVE = (
    "import resource\n"
    "size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024\n"
    f"np.empty(max(int(({_LEAST_MB} + {_MORE_MB} * secret) * 2**20) - size, 0), np.uint8)"
)
_PRETEND = (
    "for one in gc.get_objects():\n"
    "    if type(one).__name__ == 'Meter':\n"
    "        one._spent.setdefault('simulate', [secret, 0.0])\n"
    "time.sleep(1.0)"
)
_CARRY = "globals().setdefault('SEEN', []).append(secret)"
MESSAGES: Mapping[str, str] = {
    "memory": candidate(before=_SECRET + _RESERVE),
    "compilation": candidate(before=_SECRET + _PRETEND),
    # The training cases have another first value: the last different one is the held-out one.
    "residuals": candidate(
        before=_SECRET + _CARRY, after="np.full(u.shape[:2] + past_y.shape[2:], 1e6 * SEEN[0])"
    ),
    "residuals of the last": candidate(
        before=_SECRET + _CARRY, after="np.full(u.shape[:2] + past_y.shape[2:], 1e6 * SEEN[-1])"
    ),
}


def _decode_by_memory(memory_mb: float) -> float:
    return (memory_mb - _LEAST_MB) / _MORE_MB


def _message_by_figures(_: Scene) -> SearchAttackResult:
    problem = small_problem("simulation")
    # The second fold: its training cases do not begin where the held-out ones do.
    fold = make_folds(problem.records, problem.rule)[1]
    secret = (float(fold.held_out[0].past_y[-1, 0]) + 5.0) / 10.0
    read: list[str] = []
    for level in _levels():
        evaluator = _evaluator(problem, fold, level)
        for name, text in MESSAGES.items():
            evaluation = evaluator.evaluate(_filled(text, problem))
            if not evaluation.folds:
                continue
            (result,) = evaluation.folds
            figures = {
                "memory": _decode_by_memory(result.memory_mb or 0.0),
                "compilation": result.compile_seconds,
                "residuals": result.diagnostics.bias * float(fold.scale[0]) / 1e6,
            }
            figure = figures[name.partition(" ")[0]]
            read += [f"{name} at {level}"] if abs(figure - secret) < _NEAR else []
    note = ", ".join(read) or f"{len(MESSAGES)} figures do not depend on a held-out value"
    return SearchAttackResult(bool(read), (Barrier.PARENT,), note, flagged=False)


def _message_plainly(_: Path) -> bool:
    """The figures of a process after it has answered."""
    problem = small_problem("simulation")
    fold = make_folds(problem.records, problem.rule)[1]
    case = fold.held_out[0]
    model = _module(MESSAGES["memory"], problem).fit(fold.train, problem.context)
    model.simulate(case.past_u[None], case.past_y[None], case.u[None])
    secret = (float(case.past_y[-1, 0]) + 5.0) / 10.0
    return abs(_decode_by_memory(peak_memory_mb("self") or 0.0) - secret) < _NEAR


# Sources that take long to read, by what they repeat up to 64 KB.

_HEAD = "def fit(t, c):\n    return None\n"
SLOW = {
    "assignments": "a=b\n",
    "numbers": "1,\n",
    "fields": "f'{a}{b}{c}'\n",
    "statements on a line": "a;",
    "docstrings on a line": "'';",
    "subscripts": "a[b]\n",
    "annotations": "a:b\n",
}
_BUSY_SECONDS = 1.0


def _slow_sources() -> Iterator[str]:
    for unit in SLOW.values():
        yield _HEAD + unit * ((60_000 - len(_HEAD)) // len(unit)) + "\n"
    yield f"{_HEAD}x = 0x{'f' * 3600}\n"
    yield f"{_HEAD}x = {'-' * 60_000}1\n"


def _busy_seconds(read: Callable[[str], object]) -> float:
    """Processor seconds of this thread over all sources."""
    begin = time.thread_time()
    for source in _slow_sources():
        with contextlib.suppress(CandidateError, SyntaxError, ValueError):
            read(source)
    return time.thread_time() - begin


def _take_long_to_read(_: Scene) -> SearchAttackResult:
    seconds = _busy_seconds(check_source)
    note = f"the search is busy for {seconds:.1f} s with {len(SLOW) + 2} sources"
    return SearchAttackResult(seconds > _BUSY_SECONDS, (Barrier.READER,), note, flagged=False)


# Compiled programs for the workers of other candidates.

_PLANTED, _FORGED = f"jit__costs-{'0' * 64}-cache", b"forged"
_PLANT = f"""
import gc
def plant():
    for one in gc.get_objects():
        if type(one).__name__ == "Programs":
            one.made[{_PLANTED!r}] = {_FORGED!r}
"""
_LIKE_THE_LIBRARY = """
from asia.models import arx
from asia.models.methods import LevenbergMarquardt
{plant}
def fit(trajectories, context):
    model = arx.train(arx.build(arx.Config(), context), trajectories, context, LevenbergMarquardt())
    plant()
    return model
"""
PLANTERS: Mapping[str, str] = {
    "by a model of its own": candidate(fit="plant()", top=_PLANT),
    "by a family of the library": _LIKE_THE_LIBRARY.format(plant=_PLANT),
    "by a default value": _LIKE_THE_LIBRARY.format(plant=_PLANT).replace(
        "context):", "context, done=plant()):"
    ),
    # No statement but those of the library: the code runs where a function is defined.
    "by an annotation": _LIKE_THE_LIBRARY.format(plant="").replace("    plant()\n", "")
    + f"\ndef other(done: exec({f'{_PLANT}plant()'!r}, {{}}), /):\n    return done\n",
}


def _plant(_: Scene) -> SearchAttackResult:
    problem, through = small_problem("simulation"), list[str]()
    fold = make_folds(problem.records, problem.rule)[0]
    for level in _levels():
        evaluator = _evaluator(problem, fold, level)
        for name, text in PLANTERS.items():
            outcome = evaluator.evaluate(_filled(text, problem)).outcome
            # An attack that fails by itself shows nothing.
            assert not isinstance(outcome, Failure), outcome
            through += [f"{name} at {level}"] if program_store().get(_PLANTED) else []
    note = ", ".join(through) or "programs of a candidate reach no other worker"
    return SearchAttackResult(bool(through), (Barrier.PARENT,), note, flagged=False)


def _plant_plainly(_: Path) -> bool:
    """A store that takes the programs of any worker."""
    problem, store = small_problem("simulation"), ProgramStore()
    programs = Programs(store.get)
    fold = make_folds(problem.records, problem.rule)[0]
    _module(PLANTERS["by a model of its own"], problem).fit(fold.train, problem.context)
    store.add(programs.made)
    return store.get(_PLANTED) == _FORGED


LIMITS = (
    CandidateAttack(
        47,
        "start a crowd",
        "starts more threads than a fit needs: in Python, in C, by threads, and only in simulate",
        {
            "Python": candidate(fit="crowd()", top=_BY_PYTHON),
            "C": candidate(fit="crowd()", top=_BY_C),
            "by threads": candidate(fit="crowd()", top=_BY_THREADS),
            "in simulate": candidate(before="crowd()", top=_BY_PYTHON),
        },
        lambda seen: seen.value is not None,
        (Barrier.PIDS, Barrier.PARENT),
        memory_mb=4096,
        folds=1,
    ),
    SearchAttack(
        48,
        "speak in a dry run",
        "says measured values in a dry run: by prints, messages, names and lines of errors, and "
        "the size of a model",
        _talk_in_a_dry_run,
        _talk_plainly,
        (Barrier.FEEDBACK,),
    ),
    SearchAttack(
        49,
        "speak by figures",
        "makes memory, compilation time and training residuals depend on a held-out value",
        _message_by_figures,
        _message_plainly,
        (Barrier.PARENT,),
    ),
    SearchAttack(
        50,
        "take long to read",
        "writes sources of 64 KB that keep a parser busy, huge integers and deep expressions",
        _take_long_to_read,
        lambda _: _busy_seconds(source_facts) > _BUSY_SECONDS,
        (Barrier.READER,),
    ),
    SearchAttack(
        58,
        "plant a compiled program",
        "puts a program of its own among those that workers of other candidates load",
        _plant,
        _plant_plainly,
        (Barrier.PARENT,),
    ),
)
