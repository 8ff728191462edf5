"""Opens hostile folders, of a run, of problems and of a workspace, with every command and every
Python entry: nothing of them executes outside the sandbox. SECURITY.md has the table of what each
executes."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from starlette.testclient import TestClient
from typer.core import TyperGroup

import asia
from asia import _plugins
from asia.analysis.ablation import ablate
from asia.analysis.confirmation import confirm
from asia.analysis.validation import validate
from asia.errors import UserError
from asia.interfaces.cli import app
from asia.interfaces.view.app import TokenOnly, kept_token, make_app
from asia.interfaces.view.followed import RunFolder
from asia.interfaces.view.streams import Streams
from asia.interfaces.workspace.server import RunDesk
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation
from asia.search.replay import replay_run
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import unpainted
from tests.unit.received.hostile import (
    HostileRun,
    make_hostile_run,
    make_hostile_workspace,
    name_code_in_run,
    plant_all,
)
from tests.unit.search.toy import arx

ROOT = Path(__file__).parents[3]
SRC = ROOT / "src" / "asia"
confined = pytest.mark.skipif(
    not LEVELS[probe().level].confined, reason="no level of this machine confines a candidate"
)


@pytest.fixture(scope="module", autouse=True)
def unpainted_pictures() -> Iterator[None]:
    """Pictures are painted from numbers; to paint them takes longer than all the rest."""
    with unpainted():
        yield


@pytest.fixture(scope="module")
def received(tmp_path_factory: pytest.TempPathFactory) -> HostileRun:
    made = make_hostile_run(tmp_path_factory.mktemp("hostile"))
    assert made.marked == [], "the search itself runs in the sandbox"
    return made


@pytest.fixture
def gift(received: HostileRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> HostileRun:
    """A copy in the current folder, where the agent class lies too."""
    here = tmp_path / "here"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("ASIA_RUNS", raising=False)
    copy = plant_all(here, received)
    monkeypatch.chdir(here)
    return copy


@pytest.fixture
def named_lock(gift: HostileRun) -> HostileRun:
    """The lock of the run names code, and so do files of its control folder."""
    name_code_in_run(gift.directory)
    return gift


@pytest.fixture(scope="module")
def taken(received: HostileRun, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A workspace whose agent planted all of this in it, and changed each file that it was given;
    its run lies outside."""
    root = tmp_path_factory.mktemp("taken")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(root / "config"))
        yield make_hostile_workspace(root, received)


@pytest.fixture
def workspace(taken: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(taken)
    monkeypatch.delenv("ASIA_RUNS", raising=False)
    return taken


def series(samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((3, 1)), np.zeros((3, 1)), np.ones((samples, 1))


# Words of a command, its row in the table, exit codes. `named` is a problem whose file names code,
# `problem` one with code beside it; the current folder is a problem of the first kind too.
DONE, REFUSED, ANY = (0,), (2,), (0, 1, 2, 3)
COMMANDS: tuple[tuple[str, str | None, tuple[int, ...]], ...] = (
    ("init mill --train problem/train.csv --inputs u --outputs y --sampling-time 0.5", None, DONE),
    ("check .", None, REFUSED),
    ("check named", None, REFUSED),
    ("check problem", None, DONE),
    ("run named --agent random", None, REFUSED),
    ("run problem --agent random --experiments 2 --name new", "asia run", (0, 3)),
    ("status gift", None, DONE),
    ("status gift --json --profile", None, DONE),
    ("show gift", None, DONE),
    ("show gift --json", None, DONE),
    ("show gift 1 2", None, DONE),
    ("show gift 2 --source", None, DONE),
    ("report gift", None, DONE),
    ("report gift --figures figures --latex tables", None, DONE),
    ("report gift --methods", None, DONE),
    ("verify gift", None, DONE),
    ("verify gift --replay", "asia verify --replay", REFUSED),
    ("verify gift --replay --trust-agent hostile_agent:Other", "asia verify --replay", REFUSED),
    ("validate gift", "asia validate", DONE),
    ("validate gift --repeat --top 1 --seeds 1", "asia validate --repeat", DONE),
    ("validate gift --ablate --seeds 1", "asia validate --ablate", DONE),
    ("linear gift", "asia linear", REFUSED),
    ("control gift --settling 20", "asia control", REFUSED),
    ("monitor gift problem/test.csv", "asia monitor", REFUSED),
    ("certify gift", "asia certify", REFUSED),
    ("next gift --duration 20", "asia next", DONE),
    ("extend gift problem/test.csv --experiments 3", "asia extend", ANY),
    ("export gift --to numpy", "asia export", REFUSED),
    ("unseal gift --yes", "asia unseal", REFUSED),
    ("unseal gift --yes --yes-process", "asia unseal", DONE),
    ("steer gift --note hello", None, DONE),
    ("note gift hello", None, DONE),
    ("query 'select *, source(run, number) from experiments'", None, DONE),
    ("agent workspace named made", None, REFUSED),
    ("agent workspace problem made --name gift", None, REFUSED),
    ("agent mcp named", None, REFUSED),
    ("agent mcp problem --name gift", None, REFUSED),
    ("agent config claude named", None, REFUSED),
    ("agent check --base-url none --model none --steps 1", None, REFUSED),
    ("agent try --dir problem --dry-run", None, REFUSED),
    ("try --dir problem --dry-run", None, REFUSED),
    ("bench agents named", None, REFUSED),
    ("doctor", None, DONE),
    ("models arx --problem named", None, REFUSED),
    ("models arx --problem problem", None, DONE),
    ("demo", None, DONE),
)
SERVED = {"view"}
"""Commands that serve until they are ended: `ENTRIES` has what they serve."""


def leaves(command: Any, path: str = "") -> Iterator[str]:
    """Names of all commands below one."""
    if isinstance(command, TyperGroup):
        for name in command.list_commands(None):
            yield from leaves(command.get_command(None, name), f"{path} {name}".strip())
    else:
        yield path


def test_every_command_is_tried() -> None:
    known = set(leaves(typer.main.get_command(app)))
    tried = {c for c in known for words, *_ in COMMANDS if f"{words} ".startswith(f"{c} ")}
    assert known - tried == SERVED


@confined
@pytest.mark.slow
@pytest.mark.parametrize(("words", "row", "codes"), COMMANDS, ids=[c[0] for c in COMMANDS])
def test_no_command_executes_it_outside_the_sandbox(
    words: str, row: str | None, codes: tuple[int, ...], gift: HostileRun
) -> None:
    done = command_line(*shlex.split(words))
    assert done.code in codes, done.err
    assert "Traceback" not in done.err
    assert gift.marked == []


@confined
@pytest.mark.slow
@pytest.mark.parametrize("words", [words for words, *_ in COMMANDS])
def test_no_command_executes_a_workspace(words: str, workspace: Path, received: HostileRun) -> None:
    """The agent's run, problems and files, opened from its folder by the user, outside the jail."""
    done = command_line(*shlex.split(words))
    assert done.code in ANY, done.err
    assert "Traceback" not in done.err
    assert "the-secret" not in done.out + done.err
    assert received.marked == []


@confined
@pytest.mark.slow
def test_no_command_executes_what_a_lock_names(named_lock: HostileRun) -> None:
    for words, *_ in COMMANDS:
        if "gift" in words and not words.startswith(("steer", "note")):
            done = command_line(*shlex.split(words))
            assert "Traceback" not in done.err
            assert named_lock.marked == [], words


@confined
@pytest.mark.slow
@pytest.mark.parametrize("words", ["check .", "report gift", "validate gift"])
def test_no_process_of_a_command_imports_from_the_current_folder(
    words: str, gift: HostileRun
) -> None:
    program = Path(sys.executable).with_name("asia")
    done = subprocess.run([program, *words.split()], capture_output=True, text=True, timeout=600)
    assert done.returncode == (2 if words == "check ." else 0), done.stderr
    assert gift.marked == []


def view_pages(gift: HostileRun) -> None:
    runs = gift.directory.parent
    token = kept_token(runs)
    assert token != "t" * 43
    app = TokenOnly(make_app(RunFolder(runs), Streams(), token), token, 8731)
    with TestClient(app, base_url="http://localhost:8731") as client:
        assert client.get(f"/?token={token}").status_code == 200
        for page in ("/runs/gift", "/runs/gift/curve", "/runs/gift/experiments/2"):
            assert client.get(page).status_code == 200
        for key in ("verdict", "identified", "integrity", "reproduce"):
            client.get(f"/runs/gift/sections/{key}")
        assert client.get(f"/runs/gift?token={'t' * 43}").status_code == 401


def refused_replay(gift: HostileRun) -> None:
    with pytest.raises(UserError, match="was not imported"):
        replay_run(gift.directory, lambda item: None)


def estimated(gift: HostileRun) -> None:
    model = asia.SystemIdentifier()
    model.run_ = asia.open_run(gift.directory)
    past_u, past_y, u = series(20)
    assert model.simulate(u, past_u=past_u, past_y=past_y).shape == (20, 1)
    assert model.predict(u, u, 2).shape == (20, 1)
    assert np.isfinite(model.score(np.arange(20.0) % 3, np.arange(20.0) % 5))
    with pytest.raises(UserError):
        model.export("numpy")
    assert model.report()
    assert repr(model)
    assert model._repr_html_()
    assert len(model.parameters_) == 0
    assert model.source_
    assert model.value_ > 0


def unsealed(gift: HostileRun) -> None:
    with pytest.raises(UserError, match="level process"):
        asia.unseal(gift.directory)
    assert asia.unseal(gift.directory, process_consent=True).first_time


ENTRIES: tuple[tuple[str | None, Callable[[HostileRun], object]], ...] = (
    (None, lambda gift: asia.load_run(gift.directory)),
    ("asia.SystemIdentifier", estimated),
    (None, lambda gift: asia.open_run(gift.directory).view),
    ("asia.simulate", lambda gift: asia.simulate(gift.directory, *series(20))),
    ("asia.simulate", lambda gift: asia.simulate(gift.directory, *series(20), bands=0.9)),
    (None, lambda gift: asia.write_report(gift.directory)),
    ("asia.unseal", unsealed),
    (None, view_pages),
    ("asia verify --replay", refused_replay),
    ("asia validate", lambda gift: validate(gift.directory)),
    (
        "asia validate --repeat",
        lambda gift: confirm(gift.directory, lambda *one: None, top=1, seeds=1),
    ),
    ("asia validate --ablate", lambda gift: ablate(gift.directory, lambda *one: None, seeds=1)),
    ("asia try --dry-run", lambda gift: RunDesk(gift.directory).dry_run(arx(1))),
    ("asia try --plot", lambda gift: RunDesk(gift.directory).simulated(2)),
)


@confined
@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "enter"), ENTRIES, ids=[f"{k} {e[0]}" for k, e in enumerate(ENTRIES)]
)
def test_no_function_executes_it_outside_the_sandbox(
    row: str | None, enter: Callable[[HostileRun], object], gift: HostileRun
) -> None:
    enter(gift)
    assert gift.marked == []


@confined
@pytest.mark.slow
def test_the_marks_appear_without_the_principle(
    gift: HostileRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same candidate at the level that its ledger names, which a user has to ask for; the same
    agent once it is trusted; the same problem where a reader looks up what its file names."""

    def obedient(path: Path, schema: object) -> None:
        monkeypatch.syspath_prepend(path.parent)
        table = tomllib.loads(path.read_text("utf-8"))
        _plugins.load_target(table["loop"]["controller"], "controller")

    try:
        with monkeypatch.context() as patch:
            patch.setattr("asia.problem.load.read_table", obedient)
            command_line("check", "named")
        assert gift.marked == ["module"]
        asia.simulate(gift.directory, *series(5), isolation=Isolation.PROCESS)
        assert {"import", "unpickle", "simulate"} <= set(gift.marked)
        done = command_line(
            "verify", "gift", "--replay", "--trust-agent", "hostile_agent:Hostile",
            "--isolation", "process",
        )  # fmt: skip
        assert "with your rights" in done.err
        assert {"agent", "fit"} <= set(gift.marked)
    finally:
        sys.modules.pop("controller", None)
        for place in (gift.marks, gift.home):
            for path in place.iterdir():
                path.unlink()


@confined
@pytest.mark.slow
def test_the_search_goes_on_at_the_level_the_user_asks_for(gift: HostileRun) -> None:
    """The forged ledger says `process`; the command says nothing, which is the strongest."""
    done = command_line(
        "run", gift.problem, "--agent", "random", "--name", "gift", "--experiments", 3
    )
    assert done.code == 2
    assert gift.marked == []


# SECURITY.md and the source.


def test_the_table_has_each_row_that_executes_something() -> None:
    text = (ROOT / "SECURITY.md").read_text("utf-8")
    _, _, rest = text.partition("## A run from somebody else")
    first = re.findall(r"^\|([^|]+)\|", rest.partition("\n## ")[0], re.MULTILINE)
    rows = {name for cell in first for name in re.findall(r"`([^`]+)`", cell)}
    tried = {row for _, row, _ in COMMANDS if row} | {row for row, _ in ENTRIES if row}
    assert rows == tried


LOADERS = re.compile(
    r"(^|\.)(exec|eval|__import__|import_module|load_target|family_module|run_path|run_module|exec_module|"
    r"load_module|spec_from_file_location|loadmat)$|(pickle|np|numpy|marshal|dill|joblib)\.loads?$|"
    r"part\.load$|^known\[name\]\.load$|CDLL$"
)
# Each place that executes or unpickles something that is not named in the source, and why a
# received run cannot use it.
ACCOUNTED = {
    "__init__.py": "names of this package",
    "_heap.py": "the C library",
    "_plugins.py": "installed packages; names in the source; `module:Name` that the user gives",
    "_source_reader.py": "two modules of this package and one of Python",
    "agents/library/pages.py": "families of ASIA and of installed packages",
    "agents/library/registry.py": "families of ASIA and of installed packages",
    "agents/registry.py": "agents that the user names; of a ledger only installed or trusted ones",
    "data/intake/formats.py": "packages of a fixed table; arrays without pickles; MATLAB data",
    "data/sources/official.py": "arrays without pickles; MATLAB data",
    "data/intake/frequency.py": "arrays without pickles; MATLAB data",
    "data/sources/__init__.py": "sources of installed packages",
    "data/sources/simulated/open_loop.py": "plants of this package, of a fixed table",
    "export/pipeline.py": "targets of installed packages",
    "export/targets/c.py": "code that ASIA printed from a checked program",
    "export/targets/matlab.py": "answers of Octave to code that ASIA printed",
    "export/targets/numpy.py": "code that ASIA printed from a checked program",
    "interfaces/cli/__init__.py": "commands of installed packages",
    "interfaces/workspace/tools.py": "the user's candidate in the user's own workspace",
    "judge/evaluation/remote.py": "work and records between machines of one search",
    "judge/executors/__init__.py": "executors of installed packages",
    "judge/sandbox/layers/landlock.py": "the C library",
    "judge/sandbox/layers/lockdown.py": "the C library",
    "judge/sandbox/layers/seccomp.py": "the C library",
    "judge/sandbox/worker/child.py": "candidates and their models, in the sandbox",
    "judge/sandbox/worker/keeper.py": "the C library",
    "judge/sandbox/worker/wire.py": "requests of the parent, read in the sandbox",
    "control/design.py": "code that ASIA printed from numbers of a design",
    "analysis/validation.py": "checks of installed packages",
    "models/_reuse.py": "results of a worker, read in a worker",
    "models/controllers.py": "models of a control problem, in the sandbox",
    "models/simulator.py": "the user's simulator, in the sandbox; one of this package anywhere",
    "models/_equations/ode.py": "numbered variables, operators and functions of a table",
    "report/page/subject.py": "sections of installed packages",
    "problem/metrics.py": "metrics of installed packages",
    "search/sinks.py": "sinks that the user names",
    "testing/family.py": "the author's own family",
}


def test_each_place_that_executes_or_unpickles_is_accounted_for() -> None:
    found = {
        path.relative_to(SRC).as_posix()
        for path in SRC.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and LOADERS.search(ast.unparse(node.func))
    }
    assert found == set(ACCOUNTED)
    for path in SRC.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.load", "numpy.load"):
                allowed = [k for k in node.keywords if k.arg == "allow_pickle"]
                assert all(ast.unparse(k.value) == "False" for k in allowed), path
