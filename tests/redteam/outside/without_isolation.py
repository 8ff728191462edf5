"""Attacks with isolation off, inside an outer sandbox: do they really work?"""

import contextlib
import importlib
import os
import pickle
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from asia.errors import Reason
from asia.problem.folds import Fold, make_folds
from tests.redteam.attacks.source import HONEST, fill_in
from tests.redteam.evidence import (
    Targets,
    conclude,
    has_score,
    said_steps,
    scores_better,
    targets,
    worst_of,
)
from tests.redteam.problem import ProblemName, SmallProblem, small_problem
from tests.redteam.types import AttackVerdict, CandidateAttack, Finding, Mistake, Observed

# An evaluation without any isolation: the usual mistakes in one place. It is called in a process of
# its own in an outer sandbox and nowhere else. Candidate and evaluator share that process; the
# metric is computed where the candidate could reach it, and its files are loaded afterwards.

_MODEL, _RESULT, _LOG = "model.bin", "result.npy", "log.txt"


def print_score(source: str, problem: SmallProblem, mistake: Mistake | None) -> None:
    """Print the mean over the folds; a value that is no number counts as 0. Raises the
    failure of a fold, unless failed folds are left out."""
    problem = problem.by_whole_records
    scores: list[float] = []
    for fold in make_folds(problem.records, problem.rule):
        try:
            scores.append(_fold_score(source, problem, fold))
        except Exception:
            if mistake is not Mistake.DROPS_FOLDS:
                raise
            traceback.print_exc()
    if not scores:
        raise ValueError("no fold is left")
    print(f"METRIC nrmse={float(np.nan_to_num(np.nanmean(scores)))!r}", flush=True)


def load_leftovers() -> None:
    """Load result, model and settings from the folder the candidate ran in, and write a log."""
    sys.path.insert(0, "")
    for load in (
        lambda: np.load(_RESULT, allow_pickle=True),
        lambda: pickle.loads(Path(_MODEL).read_bytes()),
        lambda: importlib.import_module("conftest"),
        lambda: Path(_LOG).write_text("judged\n"),
    ):
        with contextlib.suppress(Exception):
            load()


def _fold_score(source: str, problem: SmallProblem, fold: Fold) -> float:
    module = ModuleType("candidate")
    sys.modules["candidate"] = module
    exec(compile(source, "candidate.py", "exec"), module.__dict__)
    model: Any = module.fit(fold.train, problem.context)
    with contextlib.suppress(Exception):
        Path(_MODEL).write_bytes(pickle.dumps(model))
    y = np.stack([block.y for block in fold.held_out])
    cases = list(fold.held_out)
    arrays = [np.stack([getattr(c, n) for c in cases]) for n in ("past_u", "past_y", "u")]
    for k in range(len(y) if problem.rule.horizon else 0):
        model.simulate(*(a[k : k + 1] for a in arrays))  # one by one first, as a trial
    y_hat = model.simulate(*arrays)
    with contextlib.suppress(Exception):
        np.save(_RESULT, y_hat)
    # Root mean square over the samples that both have.
    samples = min(y.shape[1], y_hat.shape[1])
    difference = y[:, :samples] - y_hat[:, :samples]
    return float(np.nan_to_num(np.sqrt(np.mean(difference**2)))) / float(fold.scale[0])


OFF, CONTROL = "off", "control"
_LONGEST_SECONDS = 15.0


def attack_without_isolation(attack: CandidateAttack) -> Finding:
    """Return whether one variant at least succeeds. Runs the attack's code for real: to be called
    inside an outer sandbox only."""
    # Here an honest candidate has a score too: to have one is no success.
    success = scores_better if attack.success is has_score else attack.success
    found: list[Finding] = []
    for name, source in attack.sources.items():
        with targets(attack.memory_mb) as given:
            seen = _observe(source, attack.problem, attack.mistake, given, attack.limit)
            finding = conclude(attack, name, seen, (), success)
            if finding.through and not success(seen):  # to leave something is not what it tries
                finding = replace(finding, verdict=AttackVerdict.NO_GAIN)
            found.append(finding)
        if found[-1].through:
            break
    return worst_of(found, attack.number, OFF)


def broken(attack: CandidateAttack) -> CandidateAttack:
    """The same with a `fit` that only raises, as a control: it must not succeed."""
    head = "def fit(trajectories, context):\n"
    raising = head + '    raise RuntimeError("a control")\n'
    return replace(attack, sources={n: s.replace(head, raising) for n, s in attack.sources.items()})


@cache
def _honest(name: ProblemName) -> float:
    with targets(0) as given:
        value = _observe(HONEST, name, None, given, _LONGEST_SECONDS, honest=0.0).value
    assert value is not None
    return value


def _observe(
    source: str,
    name: ProblemName,
    mistake: Mistake | None,
    given: Targets,
    limit: float,
    honest: float | None = None,
) -> Observed:
    honest, problem = _honest(name) if honest is None else honest, small_problem(name)
    source = fill_in(source, given.source, problem)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        Path(folder, "candidate.py").write_text(source)
        begin = time.monotonic()
        patience = min(limit + 2.0, _LONGEST_SECONDS)
        ended = _run_forked(partial(print_score, source, problem, mistake), folder, patience)
        seconds = time.monotonic() - begin
        _run_forked(load_leftovers, folder, _LONGEST_SECONDS)
    # The first score that was printed, if the evaluation came to its end.
    value: float | None = None
    if ended.code == 0:
        printed = re.search(r"METRIC nrmse=(\S+)", ended.output)
        if printed is not None:
            with suppress(ValueError):
                value = float(printed[1])
        elif mistake is Mistake.STARTS_AT_ZERO:
            value = 0.0
    killed = ended.code in (128 + signal.SIGKILL, -signal.SIGKILL)
    survivors = given.traces.survivors()
    return Observed(
        value=value,
        honest=honest,
        reason=Reason.MEMORY if killed and mistake is Mistake.BELIEVES_CODES else None,
        detail=ended.errors,
        output=ended.output,
        steps=said_steps(ended.output),
        seconds=seconds,
        limit=limit,
        overran=ended.code is None,
        ran=given.ran,
        ledger=given.ledger_changed,
        leaked=given.secret in ended.output,
        hurt=given.neighbour.hurt,
        survivors=survivors,
        strays=given.traces.strays(),
    )


@dataclass(frozen=True)
class _Ended:
    """End of a process."""

    code: int | None
    """Exit code; None if it had to be killed."""
    output: str
    errors: str


def _run_forked(job: Callable[[], None], folder: str, seconds: float) -> _Ended:
    """Run a job in a forked process of its own; starting Python anew would take most of the
    time."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.chdir(folder)
            for number, name in ((1, ".out"), (2, ".err")):
                os.dup2(os.open(name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
            job()
            status = 0
        except SystemExit:
            status = 0
        except BaseException:  # noqa: BLE001 - whatever a candidate raises ends here
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status)
    end, late = time.monotonic() + seconds, False
    while (done := os.waitpid(child, os.WNOHANG))[0] == 0:
        time.sleep(0.002)
        if time.monotonic() > end and not late:
            late = True
            os.kill(child, signal.SIGKILL)
    code = None if late else os.waitstatus_to_exitcode(done[1])
    texts = (Path(folder, name).read_text(errors="replace") for name in (".out", ".err"))
    return _Ended(code, *texts)
