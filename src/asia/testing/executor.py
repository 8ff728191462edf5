"""Conformance suite for executors."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from asia.judge.executors import Executor

_JOBS = 20


def check_executor(make: Callable[[], Executor]) -> None:
    """Give an executor jobs that return, wait and raise.

    Checked: results come in the order of the jobs, whichever ends first, for none, one and many;
    an executor can be used again; when jobs raise, the first of these exceptions is raised as it
    is, after all the others have ended; several threads may give it jobs at the same time, and each
    gets its own results.
    """
    executor = make()
    assert executor.run(list[Callable[[], int]]()) == [], "no jobs must give no results"
    assert executor.run([partial(_after, 0.0, 7)]) == [7], "one job must give its result"
    jobs = [partial(_after, 0.02 * (number % 3 == 0), number) for number in range(_JOBS)]
    for _ in range(2):
        assert executor.run(jobs) == list(range(_JOBS)), "results must come in the order of jobs"
    _check_exceptions(make())
    _check_several_threads(make())


def _check_exceptions(executor: Executor) -> None:
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, str(number)) for number in range(4)]
        jobs = [partial(_fail, "first"), *(partial(_touch, file) for file in files)]
        raised = _raised(executor, [*jobs, partial(_fail, "second")])
        assert raised is not None, "the exception of a job was lost"
        assert raised.args == ("first",), f"the first exception must be raised, not {raised!r}"
        missing = [file.name for file in files if not file.exists()]
        assert not missing, f"{len(missing)} jobs had not ended when another's exception was raised"
    assert executor.run([partial(_after, 0.0, 1)]) == [1], "an exception left it unusable"


def _check_several_threads(executor: Executor) -> None:
    given = [[partial(_after, 0.01, 100 * batch + n) for n in range(3)] for batch in range(4)]
    with ThreadPoolExecutor(len(given)) as threads:
        found = list(threads.map(executor.run, given))
    expected = [[100 * batch + n for n in range(3)] for batch in range(4)]
    assert found == expected, "jobs that several threads give must not mix"


def _raised(executor: Executor, jobs: list[partial[None]]) -> LookupError | None:
    try:
        executor.run(jobs)
    except LookupError as error:
        return error
    return None


def _after(seconds: float, value: int) -> int:
    time.sleep(seconds)
    return value


def _touch(path: Path) -> None:
    time.sleep(0.05)
    path.touch()


def _fail(word: str) -> None:
    raise LookupError(word)
