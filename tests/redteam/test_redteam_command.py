"""`asia doctor --attack` and `python -m tests.redteam`: output, refusals, nothing left behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from asia.errors import UserError
from asia.interfaces.cli import app
from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation
from asia.testing import attacks as doctor_attacks
from tests.redteam.__main__ import main
from tests.redteam.attacks.doctor import DOCTOR
from tests.redteam.outside import outer_sandbox
from tests.redteam.outside.outer_sandbox import inside, why_no_outer
from tests.redteam.outside.without_isolation import CONTROL, OFF
from tests.redteam.types import AttackVerdict, Finding

ROOT = Path(__file__).parents[2]
WORKING = tuple(x for x in (Isolation.NAMESPACE, Isolation.LANDLOCK) if why_not(x) is None)
ONE_LEVEL = WORKING[0] if WORKING else None
needs_level = pytest.mark.skipif(ONE_LEVEL is None, reason="no level keeps intent in here")
needs_outer = pytest.mark.skipif(why_no_outer() is not None, reason=str(why_no_outer()))


@pytest.mark.slow
@needs_level
def test_doctor_stops_one_attack_of_each_kind():
    done = CliRunner().invoke(app, ["doctor", "--attack", "--json"])
    assert done.exit_code == 0, done.output
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(row["level"], row["attack"]) for row in found] == [
        (level, attack.name) for level in WORKING for attack in doctor_attacks.ATTACKS
    ]
    assert all(row["stopped"] for row in found)
    how = {row["attack"]: row["how"] for row in found}
    assert how["forge the answer"] == "unsolicited"
    assert how["look ahead in the inputs"].startswith("suspect: look-ahead")
    count = len(found)
    assert f"{count} of {count} attacks stopped" in done.stderr


@pytest.mark.long
@needs_outer
def test_each_attack_of_doctor_succeeds_with_isolation_off_and_not_by_failing():
    numbers = [str(attack.number) for attack in DOCTOR]
    assert [f.number for f in inside([OFF, "", *numbers]) if not f.through] == []
    assert [f.number for f in inside([CONTROL, "", *numbers]) if f.through] == []


@needs_level
def test_doctor_fails_when_something_gets_through(monkeypatch):
    """An attack that is honest and better, one that prints success, and one that never ran."""
    better = doctor_attacks.Attack("better", simulate="y = y + 0.5 * (u[:, :, 1:2] - y)")
    loud = doctor_attacks.Attack("loud", "attempt('pass')")
    broken = doctor_attacks.Attack("broken", "no_such_name")
    monkeypatch.setattr(doctor_attacks, "ATTACKS", (better, loud, broken))
    found = list(doctor_attacks.run_attacks(ONE_LEVEL))
    assert [one.stopped for one in found] == [False, False, False]
    assert found[2].how.startswith("crash: ")


def test_doctor_runs_no_attack_where_no_level_confines(monkeypatch):
    monkeypatch.setattr("asia.judge.sandbox.availability.why_not", lambda level: "not here")
    done = CliRunner().invoke(app, ["doctor", "--attack"])
    assert isinstance(done.exception, UserError)
    assert "no level of namespace, landlock works here" in str(done.exception)


@pytest.mark.slow
@needs_level
def test_the_suite_prints_a_table_and_a_verdict(capsys):
    assert main(["--only", "2", "34", "--level", str(ONE_LEVEL), "--no-prove"]) == 0
    done = capsys.readouterr()
    wall = "namespaces" if ONE_LEVEL is Isolation.NAMESPACE else "landlock"
    assert f"| 2  | write the evaluator's code | blocked: {wall}" in done.out
    assert "| 34 | divide by nothing          | any level: blocked: problem check" in done.out
    assert "2 of 2 blocked or flagged" in done.out
    assert "34 divide by nothing" in done.err


@needs_level
def test_the_suite_fails_when_something_gets_through(monkeypatch, capsys):
    from tests.redteam import suite as _suite

    finding = Finding(2, str(ONE_LEVEL), AttackVerdict.THROUGH, (), "done")
    monkeypatch.setattr(_suite, "attack_candidate", lambda attack, level, executor: finding)
    assert main(["--only", "2", "--level", str(ONE_LEVEL), "--no-prove", "--json"]) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert json.loads(first)["verdict"] == "through"
    assert last.startswith("0 of 1 blocked or flagged")


@needs_level
def test_the_suite_fails_when_an_attack_does_not_work(monkeypatch, capsys):
    from tests.redteam import suite as _suite

    blocked = Finding(2, str(ONE_LEVEL), AttackVerdict.BLOCKED, ("landlock",), "")
    clumsy = Finding(2, OFF, AttackVerdict.BLOCKED, ("parent",), "no score")
    monkeypatch.setattr(outer_sandbox, "why_no_outer", lambda: None)
    monkeypatch.setattr(_suite, "attack_candidate", lambda attack, level, executor: blocked)
    monkeypatch.setattr(_suite, "inside", lambda job, nested: iter([clumsy]))
    assert main(["--only", "2", "--level", str(ONE_LEVEL)]) == 1
    done = capsys.readouterr()
    assert "blocked: landlock | DOES NOT SUCCEED |" in done.out
    assert "1 of 1 blocked or flagged, 0 of 1 succeed with isolation off (not 2)" in done.out


@needs_level
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "999"], "there are attacks 1, 2, 3"),
        (["--level", "bunker"], "expected some of namespace, landlock, process"),
        (["--without", "namespaces"], "is level landlock"),
        (["--without", "look-ahead", "seccomp"], "expected 'each', 'checks', layers, or checks"),
    ],
)
def test_the_suite_refuses_unknown_arguments(words, said, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
@needs_level
def test_two_interrupts_leave_nothing_behind(tmp_path):
    command = [sys.executable, "-m", "tests.redteam", "--no-prove"]
    command += ["--level", str(ONE_LEVEL), "--only", "13", "18", "19", "22"]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, env=environment, text=True, cwd=ROOT
    ) as process:
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
    assert [*tmp_path.iterdir()] == []
