"""Trial start of a program at a level."""

from __future__ import annotations

import subprocess

START_SECONDS = 20.0
_LONGEST_LINE = 200


def run_trial(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a short program without an environment; both outputs come back as one text. Raises
    OSError, subprocess.TimeoutExpired."""
    return subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={},
        cwd="/",
        timeout=START_SECONDS,
        check=False,
    )


def last_line(trial: subprocess.CompletedProcess[str], silent: str) -> str:
    """Return the last line that the trial printed; `silent` where it printed nothing."""
    return (trial.stdout.strip().splitlines() or [silent])[-1][:_LONGEST_LINE]
