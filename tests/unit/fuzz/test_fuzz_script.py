"""The script lists what it can fuzz and refuses what it cannot, without atheris."""

import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.targets import NAMES

SCRIPT = Path(__file__).parents[3] / "fuzz" / "run.py"


def script(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_it_lists_the_parsers() -> None:
    assert script("--list").stdout.split() == list(NAMES)


@pytest.mark.slow
def test_an_unknown_parser_is_refused() -> None:
    done = script("csv", "pickle")
    assert done.returncode == 2
    assert "expected parsers of: problem, lock, csv" in done.stderr
