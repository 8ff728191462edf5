import pytest

from asia.judge.sandbox.availability import open_worker, why_not
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.testing import check_sandbox, sandbox

REASONS = {level: why_not(level) for level in Isolation if level is not Isolation.SANDBOX_EXEC}
LEVELS = [
    pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level, reason in REASONS.items()
]


@pytest.mark.parametrize("level", LEVELS, ids=str)
def test_level_conforms(level: Isolation) -> None:
    walled = level is not Isolation.PROCESS
    check_sandbox(lambda limits: open_worker(level, limits), walled=walled)


def test_the_suite_refuses_a_level_that_claims_missing_layers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("answers", "failures", "deadlines", "environment", "nothing_is_left"):
        monkeypatch.setattr(sandbox, f"_check_{name}", lambda *arguments: None)
    with pytest.raises(AssertionError, match="could read a file of the parent"):
        check_sandbox(lambda limits: open_worker(Isolation.PROCESS, limits))


@pytest.mark.parametrize(
    ("level", "messages"),
    [
        (Isolation.NAMESPACE, "flock, fcntl$"),
        (Isolation.LANDLOCK, "flock, fcntl, msgget$"),
    ],
)
def test_the_suite_refuses_a_level_without_a_filter_on_system_calls(
    level: Isolation, messages: str
) -> None:
    if REASONS[level] is not None:
        pytest.skip(str(REASONS[level]))
    case = sandbox._Case()

    def thin(limits: Limits) -> Worker:
        return open_worker(level, limits, without=(Layer.SECCOMP,))

    with pytest.raises(AssertionError, match=r"set attributes of a file, start a process$"):
        sandbox._check_walls(thin, case)
    with pytest.raises(AssertionError, match=messages):
        sandbox._check_no_messages(thin, case)
