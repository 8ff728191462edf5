"""Sources are parsed in several threads at once: the desk's, the search's."""

from __future__ import annotations

import ast
import gc
import sys
import threading
from collections.abc import Generator

import pytest

from asia.candidate import source_tree

SOURCE = "def fit(trajectories, context):\n" + "    x = [1, (2, {3: 4}), lambda a: a + 1]\n" * 40


@pytest.fixture
def hasty() -> Generator[None]:
    """The collector runs often, calls Python, and threads change at each chance."""
    interval, thresholds = sys.getswitchinterval(), gc.get_threshold()

    def callback(phase: str, info: dict[str, int]) -> None:
        sum(range(50))

    sys.setswitchinterval(1e-5)
    gc.set_threshold(50, 2, 2)
    gc.callbacks.append(callback)
    yield
    gc.callbacks.remove(callback)
    gc.set_threshold(*thresholds)
    sys.setswitchinterval(interval)


@pytest.mark.slow
@pytest.mark.usefixtures("hasty")
def test_threads_do_not_disturb_each_other() -> None:
    found: list[str] = []

    def parse(depth: int) -> None:
        if depth:
            parse(depth - 1)
        else:
            found.extend(ast.dump(source_tree(SOURCE)) for _ in range(15))

    threads = [threading.Thread(target=parse, args=(depth,)) for depth in (1, 7, 13, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 60
    assert len(set(found)) == 1
