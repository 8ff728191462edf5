"""Orphan processes after a kill during the start of a worker."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.process import OrphanWatch


@contextmanager
def waiting(name: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process that waits, in a session of its own, with this as the first word."""
    with subprocess.Popen(
        [name, "600"], executable="/bin/sleep", start_new_session=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_only_marked_processes_are_ended():
    watch, other = OrphanWatch(), OrphanWatch()
    with waiting(watch.mark) as orphan, waiting(other.mark) as neighbour:
        watch.end_orphans()
        assert orphan.wait(10.0) == -signal.SIGKILL
        assert neighbour.poll() is None
        other.dismiss()
        assert neighbour.poll() is None


@pytest.mark.slow
@pytest.mark.skipif(why_not(Isolation.NAMESPACE) is not None, reason="no namespaces")
def test_kills_while_workers_start_leave_no_process():
    script = Path(__file__).parents[4] / "benchmarks" / "machinery" / "kill.py"
    done = subprocess.run(
        [sys.executable, str(script), "--starts", "20"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout == "20 kills of processes that start workers: 0 processes left\n"
