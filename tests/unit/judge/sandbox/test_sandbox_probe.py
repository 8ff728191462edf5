import os
import subprocess
import sys
from pathlib import Path

import pytest

import asia
from asia.errors import SandboxError
from asia.judge.sandbox import level
from asia.judge.sandbox.availability import open_worker, probe, why_not
from asia.judge.sandbox.layers.environment import interpreter
from asia.judge.sandbox.levels import LEVELS, landlock
from asia.judge.sandbox.levels.sandbox_exec import profile
from asia.judge.sandbox.types import Isolation, Layer, Limits

NEXT_BEST = next(
    level for level in Isolation if level is not Isolation.NAMESPACE and why_not(level) is None
)


def fake_bwrap(tmp_path, monkeypatch, script: str) -> None:
    program = tmp_path / "bwrap"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))


def no_landlock(monkeypatch, *layers: Layer) -> None:
    reasons = dict.fromkeys(layers, "this kernel has none of it")
    monkeypatch.setattr(level, "missing_layers", lambda: reasons)


def test_without_bubblewrap_the_next_level_is_taken_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    found = probe()
    assert found.level is NEXT_BEST
    assert "bubblewrap is not installed" in found.notes[0]
    assert found.layers == LEVELS[NEXT_BEST].layers
    with pytest.raises(SandboxError):
        open_worker(Isolation.NAMESPACE, Limits(1.0, 1.0, 1024))


def test_without_anything_the_level_is_process_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    no_landlock(monkeypatch, Layer.LANDLOCK)
    found = probe()
    assert found.level is Isolation.PROCESS
    assert found.layers == (Layer.RLIMITS, Layer.PIDS)
    assert [note.partition(":")[0] for note in found.notes] == ["namespace", "landlock"]
    with pytest.raises(SandboxError, match="none of it"):
        open_worker(Isolation.LANDLOCK, Limits(1.0, 1.0, 1024))
    with pytest.raises(SandboxError, match="none of it"):
        probe(Isolation.LANDLOCK)


@pytest.mark.skipif(why_not(Isolation.NAMESPACE) is not None, reason="no namespaces")
def test_a_kernel_without_landlock_keeps_namespaces_and_names_the_missing_layer(monkeypatch):
    no_landlock(monkeypatch, Layer.LANDLOCK)
    found = probe()
    assert found.level is Isolation.NAMESPACE
    assert found.notes == ("namespace without landlock: this kernel has none of it",)
    assert found.layers == (Layer.NAMESPACES, Layer.SECCOMP, Layer.RLIMITS, Layer.PIDS)


def test_a_weaker_level_is_there_for_the_asking():
    found = probe(Isolation.PROCESS)
    assert found.level is Isolation.PROCESS
    assert found.notes == ("requested by the user",)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo bubblewrap 0.4.1", "0.8 or newer"),
        (
            'if [ "$1" = --version ]; then echo bubblewrap 0.9.0; exit; fi\n'
            "echo 'bwrap: No permissions to create new namespace' >&2; exit 1",
            "No permissions to create new namespace",
        ),
    ],
)
def test_a_bubblewrap_that_cannot_work_is_named(tmp_path, monkeypatch, script, words):
    fake_bwrap(tmp_path, monkeypatch, script)
    found = probe()
    assert found.level is NEXT_BEST
    assert any(words in note for note in found.notes)


def test_a_bubblewrap_that_fails_at_once_is_a_sandbox_error(tmp_path, monkeypatch):
    fake_bwrap(tmp_path, monkeypatch, "echo 'bwrap: broken' >&2; exit 1")
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(SandboxError, match="bwrap: broken"):
        open_worker(Isolation.NAMESPACE, Limits(1.0, 1.0, 1024))
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.skipif(why_not(Isolation.LANDLOCK) is not None, reason="no Landlock")
def test_a_worker_that_cannot_lock_itself_in_does_not_start(monkeypatch):
    """The last folder of the list becomes a layer's name: nothing runs behind half a wall."""
    monkeypatch.setattr(landlock, "child_command", lambda *a: ["/bin/sh", "-c", "echo no; exit 1"])
    with (
        open_worker(Isolation.LANDLOCK, Limits(1.0, 1.0, 1024)) as worker,
        pytest.raises(SandboxError, match="did not start: no"),
    ):
        worker.load("", b"", None)


def test_the_profile_of_macos_denies_by_default_and_quotes_paths(monkeypatch):
    monkeypatch.setattr(
        "asia.judge.sandbox.levels.sandbox_exec.code_folders", lambda: [('/a "b"', "/c\\d")]
    )
    lines = profile().splitlines()
    assert lines[:2] == ["(version 1)", "(deny default)"]
    assert {"(deny network*)", "(deny process-fork)"} <= set(lines)
    assert '(subpath "/a \\"b\\"")' in profile()
    assert '(subpath "/c\\\\d")' in profile()
    assert profile().count("(") == profile().count(")")
    writes = [line for line in lines if "write" in line]
    assert writes == ['(allow file-write-data (literal "/dev/null") (literal "/dev/zero"))']


@pytest.mark.skipif(why_not(Isolation.NAMESPACE) is not None, reason="no namespaces")
@pytest.mark.parametrize("linked", [False, True], ids=["folder", "link"])
def test_an_environment_reached_by_a_path_with_dots_has_every_level(tmp_path, linked: bool):
    environment, here = Path(sys.prefix), Path(sys.prefix).parent
    if linked:
        environment, here = tmp_path / "link", tmp_path
        environment.symlink_to(sys.prefix)
    script = (
        "from asia.judge.sandbox.types import Isolation, Limits\n"
        "from asia.judge.sandbox.availability import open_worker\n"
        "with open_worker(Isolation.NAMESPACE, Limits(60.0, 60.0, 1024)) as worker:\n"
        "    print('opened')\n"
    )
    # Python itself takes the dots out of an absolute path.
    python = Path("..", environment.parent.name, environment.name, "bin", Path(sys.executable).name)
    found = subprocess.run(
        [python, "-c", script], cwd=here, capture_output=True, text=True, check=False
    )
    assert (found.stdout, found.stderr) == ("opened\n", "")


@pytest.mark.parametrize(
    ("path", "straight"),
    [
        ("link/../c/./python", "a/c/python"),
        ("c/../link/python", "link/python"),
        ("..c/d//python", "..c/d/python"),
    ],
)
def test_dots_lead_up_from_where_a_link_leads(tmp_path, monkeypatch, path: str, straight: str):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "a" / "b")
    monkeypatch.setattr(sys, "executable", f"{tmp_path}/{path}")
    assert interpreter() == f"{tmp_path}/{straight}"


def test_the_package_starts_as_a_program():
    found = subprocess.run(
        [sys.executable, "-m", "asia", "--version"], capture_output=True, text=True, check=True
    )
    assert found.stdout == f"asia {asia.__version__}\n"
