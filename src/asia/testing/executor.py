"""Conformance suite for executors."""

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from asia.judge.executors import Executor


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
    jobs = [partial(_after, 0.02 * (number % 3 == 0), number) for number in range(20)]
    for _ in range(2):
        assert executor.run(jobs) == list(range(20)), "results must come in the order of jobs"
    executor = make()
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, str(number)) for number in range(4)]
        touches = [partial(_touch, file) for file in files]
        raised: LookupError | None = None
        try:
            executor.run([partial(_fail, "first"), *touches, partial(_fail, "second")])
        except LookupError as error:
            raised = error
        assert raised is not None, "the exception of a job was lost"
        assert raised.args == ("first",), f"the first exception must be raised, not {raised!r}"
        missing = [file.name for file in files if not file.exists()]
        assert not missing, f"{len(missing)} jobs had not ended when another's exception was raised"
    assert executor.run([partial(_after, 0.0, 1)]) == [1], "an exception left it unusable"
    numbers = [[100 * batch + n for n in range(3)] for batch in range(4)]
    batches = [[partial(_after, 0.01, n) for n in batch] for batch in numbers]
    with ThreadPoolExecutor(len(batches)) as threads:
        found = list(threads.map(make().run, batches))
    assert found == numbers, "jobs that several threads give must not mix"


def _after(seconds: float, value: int) -> int:
    time.sleep(seconds)
    return value


def _touch(path: Path) -> None:
    time.sleep(0.05)
    path.touch()


def _fail(word: str) -> None:
    raise LookupError(word)
