import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from asia import _plugins
from asia._plugins import Part
from asia.errors import UserError
from asia.interfaces.cli import app
from asia.judge.sandbox import level
from asia.judge.sandbox.availability import machine, probe, survey
from asia.judge.sandbox.layers import environment as own_layers
from asia.judge.sandbox.layers import environment as surroundings
from asia.judge.sandbox.levels import namespace
from asia.judge.sandbox.types import Isolation, Layer
from asia.search import run as search_environment
from asia.search.run import environment, environment_changes


def doctor(*words: str) -> str:
    done = CliRunner().invoke(app, ["doctor", *words])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_json_says_the_level_that_a_search_takes():
    found = json.loads(doctor("--json"))
    assert found["level"] == probe().level
    assert found["levels"][0]["level"] == "namespace"
    assert found["levels"][-1]["level"] == "process"
    for state in found["levels"]:
        assert state["works"] or state["lacks"]
        assert state["works"] == bool(state["layers"])
        for lack in state["lacks"]:
            assert lack["reason"]
            assert lack["remedy"]
    assert found["machine"]["cores"] >= 1


def test_text_marks_one_level(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    text = doctor()
    assert text.count("<- what a search uses here") == 1
    assert "apt install bubblewrap" in text
    assert "bubblewrap none" in text


def plug(monkeypatch, *parts: Part) -> None:
    monkeypatch.setattr(_plugins, "parts", lambda: parts)


def test_parts_of_other_packages_are_listed_and_a_broken_one_is_a_line(monkeypatch):
    good = Part("asia.metrics", "good", "json:dumps", "asia-extra", "1.2")
    bad = Part("asia.agents", "bad", "no_such_module:Agent", "asia-broken", "0.1")
    plug(monkeypatch, good, bad)
    text = doctor()
    assert "metrics good  json:dumps, of asia-extra 1.2\n" in text
    assert "does not load: bad of package asia-broken 0.1: cannot import no_such_module" in text
    found = json.loads(doctor("--json"))
    assert [part["failure"] is None for part in found["parts"]] == [True, False]
    assert found["parts"][0] == {
        "kind": "metrics", "name": "good", "package": "asia-extra", "version": "1.2",
        "target": "json:dumps", "failure": None,
    }  # fmt: skip


def test_nothing_plugged_in_and_a_clash_are_said(monkeypatch):
    plug(monkeypatch)
    assert "plugged in   nothing: no other package adds a part" in doctor()

    def clash() -> None:
        raise UserError("packages a and b both bring 'x'")

    monkeypatch.setattr(_plugins, "parts", clash)
    assert "packages a and b both bring 'x'" in doctor()
    assert json.loads(doctor("--json"))["clash"] == "packages a and b both bring 'x'"


def test_the_ledger_names_packages_that_bring_parts(monkeypatch):
    before = environment("expert")
    part = Part("asia.metrics", "good", "json:dumps", "asia-extra", "1.2")
    monkeypatch.setattr(search_environment, "parts", lambda: (part,))
    after = environment("expert")
    assert after == {**before, "asia-extra": "1.2"}
    assert environment_changes(before, after) == ("asia-extra 1.2 here, missing then",)
    assert environment_changes(after, after) == ()
    old = {name: value for name, value in after.items() if name != "asia.models"}
    assert environment_changes(old, after) == (
        f"asia.models {after['asia.models']} here, not recorded then",
    )


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        ("this kernel has no Landlock (it came with Linux 5.13)", "5.13 or newer"),
        ("Landlock is switched off at boot", "lsm="),
        ("Landlock was refused: Operation not permitted", "seccomp profile"),
    ],
)
def test_each_lack_of_landlock_has_its_remedy(monkeypatch, reason, words):
    monkeypatch.setattr(own_layers.landlock, "why_not", lambda: reason)
    monkeypatch.setattr(level, "missing_layers", lambda: {Layer.LANDLOCK: reason})
    states = {state.level: state for state in survey()}
    landlock = states[Isolation.LANDLOCK]
    assert not landlock.works
    assert landlock.lacks[0].reason == reason
    assert words in landlock.lacks[0].remedy
    walled = states[Isolation.NAMESPACE]
    if walled.works:
        assert Layer.LANDLOCK not in walled.layers
        assert walled.lacks[0].what == "landlock"


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("_APPARMOR", "1\n", "AppArmor"),
        ("_CLONE", "0\n", "unprivileged_userns_clone=1"),
        ("_MOST", "0\n", "max_user_namespaces"),
    ],
)
def test_each_switch_that_stops_namespaces_has_its_remedy(
    monkeypatch, tmp_path: Path, setting, value, words
):
    for name in ("_APPARMOR", "_CLONE", "_MOST"):
        monkeypatch.setattr(namespace, name, tmp_path / "absent")
    program = tmp_path / "bwrap"
    program.write_text("#!/bin/sh\necho bubblewrap 0.9.0; [ $1 = --version ]\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "value").write_text(value)
    monkeypatch.setattr(namespace, setting, tmp_path / "value")
    (state,) = (state for state in survey() if state.level is Isolation.NAMESPACE)
    assert not state.works
    assert words in state.lacks[0].remedy


def test_facts_of_this_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(surroundings, "_CONTAINERS", (tmp_path,))
    assert machine().container
    assert machine().python.startswith("3.")


def test_macos_gets_its_levels_and_the_advice_to_use_linux(monkeypatch):
    monkeypatch.setattr("sys.platform", "darwin")
    text = doctor()
    assert "macOS      ASIA was not tested on macOS." in text
    assert "Use a Linux virtual machine or container" in text
    assert "\nsandbox-exec does not work" in text  # this machine has no such program
    assert "\nprocess      works: rlimits   <- what a search uses here" in text


@pytest.mark.parametrize("command", ["doctor", "run two_tanks_sim", "status"])
def test_windows_is_sent_to_wsl(command: str):
    """Windows has none of the modules fcntl, resource, termios and pwd."""
    program = (
        "import sys; "
        "sys.modules.update(dict.fromkeys(('fcntl', 'resource', 'termios', 'pwd', 'grp'))); "
        "import asia.interfaces.cli, zoneinfo; sys.platform = 'win32'; asia.interfaces.cli.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *command.split()], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.startswith(
        "asia: ASIA does not run on Windows directly. Run `wsl --install`"
    )
    assert done.stderr.count("\n") == 1
