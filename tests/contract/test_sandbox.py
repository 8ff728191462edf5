import pytest

from asia.sandbox import Isolation, open_worker, why_not
from asia.testing import check_sandbox

REASONS = {level: why_not(level) for level in Isolation if level is not Isolation.SANDBOX_EXEC}
LEVELS = [
    pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level, reason in REASONS.items()
]


@pytest.mark.parametrize("level", LEVELS, ids=str)
def test_level_conforms(level: Isolation) -> None:
    walled = level is not Isolation.PROCESS
    check_sandbox(lambda limits: open_worker(level, limits), walled=walled)


def test_the_suite_refuses_a_level_without_walls_that_says_it_has_some() -> None:
    with pytest.raises(AssertionError, match="could read a file of the parent"):
        check_sandbox(lambda limits: open_worker(Isolation.PROCESS, limits))
