"""Each layer of the sandbox matters: what comes back when it is left out."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from asia.sandbox import Isolation, why_not

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "layers.py"
VISIBLE = {"see that the test file is there"}
REASON = why_not(Isolation.NAMESPACE) or why_not(Isolation.LANDLOCK)
if shutil.which("unshare") is None:
    REASON = "the program unshare is not installed"
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


@pytest.fixture(scope="module")
def succeeded() -> dict[str, set[str]]:
    """Attacks that succeed, by configuration; run in an outer sandbox."""
    command = [sys.executable, str(SCRIPT), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return {name: {a for a, won in result.items() if won} for name, result in found.items()}


def test_nothing_gets_through_whole_walls(succeeded):
    assert succeeded["namespace"] == set()
    assert succeeded["landlock"] == VISIBLE  # whether a file exists is what Landlock leaves open


@pytest.mark.parametrize(
    ("configuration", "back"),
    [
        (
            "namespace - landlock",
            {"make files without end", "read the command line of process 1"},
        ),
        ("namespace - seccomp", {"start another process"}),
        ("namespace - rlimits", {"use more memory than allowed"}),
        (
            "landlock - landlock",
            {"read the test file", "make files without end", "read another process's environment"},
        ),
        (
            "landlock - seccomp",
            {
                "change the attributes of the test file",
                "slow another process down",
                "send datagrams to a service",
                "connect to a daemon's socket file",
                "leave a process behind",
                "leave shared memory behind",
                "make a namespace of its own",
            },
        ),
        ("landlock - rlimits", {"use more memory than allowed"}),
        ("process", {"read the test file", "signal another process", "connect to a TCP service"}),
    ],
)
def test_attacks_come_back_without_a_layer(succeeded, configuration, back):
    assert back <= succeeded[configuration]


def test_namespaces_alone_keep_what_lies_outside_them(succeeded):
    alone = succeeded["namespace - landlock - seccomp"]
    assert not alone & {
        "read the test file",
        "see that the test file is there",
        "signal another process",
        "connect to a TCP service",
        "send datagrams to a service",
        "leave a process behind",
        "leave shared memory behind",
    }
