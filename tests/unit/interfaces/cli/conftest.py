import contextlib
import io
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

from asia.interfaces.cli import main
from tests.once import made_once
from tests.unit.painting import painted, unpainted
from tests.unit.search.toy import write_problem


@dataclass(frozen=True)
class Done:
    code: int
    out: str
    err: str


Asia = Callable[..., Done]


def command_line(*words: object) -> Done:
    """`asia WORDS` in this process."""
    out, err = io.StringIO(), io.StringIO()
    before, sys.argv = sys.argv, ["asia", *(str(w) for w in words)]
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    finally:
        sys.argv = before
    return Done(code, out.getvalue(), err.getvalue())


class Terminal:
    """A person who answers in turn."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)

    def isatty(self) -> bool:
        return True

    def readline(self, *_: object) -> str:
        return self.answers.pop(0) + "\n"

    def fileno(self) -> int:
        raise OSError


@dataclass(frozen=True)
class Searched:
    """A finished search of one experiment: what it printed, and a copy of it to change at will."""

    printed: Done
    problem: Path
    runs: Path
    name: str = "toy-random-s0"

    @property
    def directory(self) -> Path:
        return self.runs / self.name


@pytest.fixture(scope="package", autouse=True)
def unpainted_pictures() -> Iterator[None]:
    """Only those of `searched` are painted."""
    with unpainted():
        yield


@pytest.fixture(scope="session")
def searched_once(tmp_path_factory: pytest.TempPathFactory) -> Searched:

    def make(root: Path) -> None:
        problem = write_problem(root / "toy")
        words = ("--agent", "random", "--experiments", 1, "--runs", root / "runs", "--json")
        with painted():
            done = command_line("run", problem, *words)
        (root / "printed.json").write_text(json.dumps(asdict(done)))

    root = made_once(tmp_path_factory, "searched", make)
    printed = Done(**json.loads((root / "printed.json").read_text()))
    return Searched(printed, root / "toy", root / "runs")


@pytest.fixture
def searched(searched_once: Searched, tmp_path: Path) -> Searched:
    runs = tmp_path / "runs"
    shutil.copytree(searched_once.runs, runs)
    return Searched(searched_once.printed, searched_once.problem, runs)


@pytest.fixture
def problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good problem, in the directory the commands run in."""
    monkeypatch.chdir(tmp_path)
    return write_problem(tmp_path / "toy")


@pytest.fixture
def asia(monkeypatch: pytest.MonkeyPatch) -> Asia:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.delenv("ASIA_RUNS", raising=False)
    return command_line
