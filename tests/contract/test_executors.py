from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

import pytest

from asia.judge.executors import Executor, LocalExecutor, SequentialExecutor
from asia.testing import check_executor

T = TypeVar("T")


class Hasty:
    """Results as they come."""

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        with ThreadPoolExecutor(4) as pool:
            return [future.result() for future in as_completed([pool.submit(j) for j in jobs])]


class Impatient:
    """Raises before the others have ended."""

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        return [job() for job in jobs]


def test_one_by_one_conforms() -> None:
    check_executor(lambda: SequentialExecutor(LocalExecutor(3)))


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_local_executor_conforms(workers: int | None) -> None:
    check_executor(lambda: LocalExecutor(workers))


@pytest.mark.parametrize(
    ("kind", "words"), [(Hasty, "in the order of jobs"), (Impatient, "had not ended")]
)
def test_the_suite_refuses_what_does_not_conform(kind: Callable[[], Executor], words: str) -> None:
    with pytest.raises(AssertionError, match=words):
        check_executor(kind)
