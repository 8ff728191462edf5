"""Fits that are ended while they run."""

import pytest

from asia.errors import SandboxError
from asia.judge.evaluation.workers import CancelFlag


def test_nothing_begins_after_a_stop_and_ended_folds_are_kept() -> None:
    flag, calls = CancelFlag(), list[int]()
    with flag.on_cancel(lambda: calls.append(1)):
        pass
    with flag.on_cancel(lambda: calls.append(2)):
        flag.cancel()
    assert calls == [2]
    with pytest.raises(SandboxError, match="not wanted any more"), flag.on_cancel(lambda: None):
        pass
