"""The outer sandbox: no network, no process and no file of this machine but the code, so that an
attack that succeeds meets nothing."""

import json
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from asia.errors import SandboxError
from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.layers.bubblewrap import bubblewrap_options
from asia.judge.sandbox.layers.environment import interpreter
from asia.judge.sandbox.types import Isolation
from tests.redteam.types import AttackVerdict, Finding

# Numbers of processes that an inner namespace has too would be mistaken for those in it.
_HIGH_PID = 'i=0; while [ $i -lt 300 ]; do ( : ); i=$((i + 1)); done; "$@"'
ROOT = Path(__file__).resolve().parents[3]
"""Checkout, from which the suite is imported."""
SUITE = (ROOT / "tests" / "__init__.py", ROOT / "tests" / "redteam")
_TMP_BYTES = 512 * 1024 * 1024


def why_no_outer(nested: bool = False) -> str | None:
    """None if there can be an outer sandbox here, else the reason in plain words. `nested`: one in
    which workers with namespaces of their own can start."""
    reason = why_not(Isolation.NAMESPACE)
    if reason is None and nested and shutil.which("unshare") is None:
        return "the program unshare is not installed"
    return reason


def inside(arguments: Sequence[str], *, nested: bool = False) -> Iterator[Finding]:
    """Findings of `python -m tests.redteam.outside ARGUMENTS` in an outer sandbox, as they come.
    Raises SandboxError where it cannot run or fails."""
    reason = why_no_outer(nested)
    if reason is not None:
        raise SandboxError(f"attacks run unprotected in an outer sandbox only, and {reason}")
    python = [interpreter(), "-B", "-m", "tests.redteam.outside", *arguments]
    command = [*outer_command(nested), "--", "/bin/sh", "-c", _HIGH_PID, "sh", *python]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, env={}, cwd="/"
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                yield read_finding(line)
        finally:
            process.kill()
    # The end of the outer sandbox ends all inside.
    if process.returncode not in (0, -9):
        raise SandboxError(f"the outer sandbox ended with exit code {process.returncode}")


def write_finding(finding: Finding) -> str:
    """One line of JSON."""
    return json.dumps(asdict(finding))


def read_finding(line: str) -> Finding:
    """The inverse of `write_finding`."""
    body = json.loads(line)
    stops, without = tuple(body.pop("stops")), tuple(body.pop("without"))
    return Finding(verdict=AttackVerdict(body.pop("verdict")), stops=stops, without=without, **body)


def outer_command(nested: bool) -> list[str]:
    """Command line up to the program. Workers with namespaces of their own need /proc whole, which
    the one that unshare mounts is and bubblewrap's is not."""
    bwrap = shutil.which("bwrap")
    assert bwrap is not None
    options = bubblewrap_options(_TMP_BYTES, shared=("pid",) if nested else (), nesting=True)
    # The root is closed by the last of these options: the suite is shown before.
    last = max(i for i, word in enumerate(options) if word == "--remount-ro")
    shown = [word for place in SUITE for word in ("--ro-bind", str(place), str(place))]
    options = [*options[:last], *shown, *options[last:], "--setenv", "PYTHONPATH", str(ROOT)]
    unshare = ["unshare", "-Urpf", "--mount-proc"] if nested else []
    return [*unshare, bwrap, *options]
