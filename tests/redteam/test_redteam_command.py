"""`asia doctor --attack`: what it prints, refuses and leaves behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from asia.interfaces.cli import app
from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.outside.without_isolation import OFF
from tests.redteam.types import AttackVerdict, Finding

WORKING = tuple(x for x in (Isolation.NAMESPACE, Isolation.LANDLOCK) if why_not(x) is None)
ONE_LEVEL = WORKING[0] if WORKING else None
needs_level = pytest.mark.skipif(ONE_LEVEL is None, reason="no level keeps intent in here")


def run(*words: str):
    return CliRunner().invoke(app, ["doctor", "--attack", *words])


@pytest.mark.slow
@needs_level
def test_the_command_prints_a_table_and_a_verdict():
    done = run("--only", "2", "--only", "34", "--level", str(ONE_LEVEL), "--no-prove")
    assert done.exit_code == 0, done.output
    wall = "namespaces" if ONE_LEVEL is Isolation.NAMESPACE else "landlock"
    assert f"| 2  | write the evaluator's code | blocked: {wall}" in done.stdout
    assert "| 34 | divide by nothing          | any level: blocked: problem check" in done.stdout
    assert "2 of 2 blocked or flagged" in done.stdout
    assert "34 divide by nothing" in done.stderr


@needs_level
def test_the_command_fails_when_something_gets_through(monkeypatch):
    from tests.redteam import suite as _suite

    finding = Finding(2, str(ONE_LEVEL), AttackVerdict.THROUGH, (), "done")
    monkeypatch.setattr(_suite, "attack_candidate", lambda attack, level, executor: finding)
    done = run("--only", "2", "--level", str(ONE_LEVEL), "--no-prove", "--json")
    assert done.exit_code == 1
    lines = [json.loads(text) for text in done.stdout.splitlines()]
    assert lines[0]["verdict"] == "through"
    assert lines[1]["summary"]["stopped"] == 0


@needs_level
def test_the_command_fails_when_an_attack_does_not_work(monkeypatch):
    from tests.redteam import suite as _suite
    from tests.redteam.outside import outer_sandbox

    blocked = Finding(2, str(ONE_LEVEL), AttackVerdict.BLOCKED, ("landlock",), "")
    clumsy = Finding(2, OFF, AttackVerdict.BLOCKED, ("parent",), "no score")
    monkeypatch.setattr(outer_sandbox, "why_no_outer", lambda: None)
    monkeypatch.setattr(_suite, "attack_candidate", lambda attack, level, executor: blocked)
    monkeypatch.setattr(_suite, "inside", lambda job, nested: iter([clumsy]))
    done = run("--only", "2", "--level", str(ONE_LEVEL))
    assert done.exit_code == 1
    assert "blocked: landlock | DOES NOT SUCCEED |" in done.stdout
    assert "1 of 1 blocked or flagged, 0 of 1 succeed with isolation off (not 2)" in done.stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "999"], f"there are attacks 1 to {len(ATTACKS)}"),
        (["--level", "bunker"], "expected one of namespace, landlock, process"),
        (["--without", "namespaces"], "is level landlock"),
        (["--without", "moat"], "expected each, checks, some of landlock, seccomp, rlimits"),
        (["--without", "each", "--quick"], "--without and --quick do not go together"),
        (["--without", "each", "--honest-on", "two_tanks_sim"], "--without and --honest-on"),
        (["--without", "each", "--no-prove"], "--without and --no-prove do not go together"),
        (["--honest-on", "two_tanks_sim", "--only", "3"], "--honest-on and --only do not"),
        (["--only", "3", "--quick"], "--only and --quick do not go together"),
    ],
)
def test_the_command_reports_unknown_arguments(words, said):
    done = run(*words)
    assert said in str(done.exception)


@needs_level
def test_an_attack_that_no_layer_has_a_part_in_is_refused():
    done = run("--without", "seccomp", "--only", "29", "--level", str(ONE_LEVEL))
    assert "no layer has a part in attack 29: " in str(done.exception)


def test_the_level_of_another_system_is_not_for_attacks(monkeypatch):
    monkeypatch.setattr("asia.judge.sandbox.availability.why_not", lambda level: "not here")
    done = run()
    assert "no level of namespace, landlock works here" in str(done.exception)


@pytest.mark.slow
@needs_level
def test_two_interrupts_leave_nothing_behind(tmp_path):
    command = [str(Path(sys.executable).with_name("asia")), "doctor", "--attack", "--no-prove"]
    command += ["--level", str(ONE_LEVEL), "--only", "13", "18", "19", "22"]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment, text=True) as process:
        while not any(tmp_path.glob("asia-redteam-*/*")):
            assert process.poll() is None
            time.sleep(0.01)
        assert process.stderr is not None
        process.send_signal(signal.SIGINT)
        for line in process.stderr:
            if line == "ending: waiting for the attack that runs\n":
                break
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
    # The second signal may come while Python ends, after all was said and tidied up.
    assert process.returncode in (130, -signal.SIGTERM)
    assert "ending" not in said
    assert said.endswith("asia: interrupted\n")
    assert [*tmp_path.iterdir()] == []
