"""asia agent workspace and asia try, as a person at a shell uses them."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from asia.interfaces.workspace.process import attended
from asia.ledger.chain import in_use
from asia.ledger.run import open_run
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.interfaces.workspace.desks import end_searches
from tests.unit.search.toy import CRASH, arx, write_problem


def over(run: Path) -> None:
    """Until the search's own process has ended."""
    end = time.monotonic() + 60
    while in_use(run / "ledger.jsonl") and time.monotonic() < end:
        time.sleep(0.1)


def lasting(source: str) -> str:
    """The candidate with a fit that takes two seconds, so that it is seen under way."""
    head = "def fit(trajectories, context):\n"
    assert head in source
    return source.replace(head, f"{head}    import time\n    time.sleep(2.0)\n")


@pytest.mark.long
def test_three_ideas_from_a_shell(tmp_path: Path, asia: Asia) -> None:
    problem = write_problem(tmp_path / "toy")
    folder, runs = tmp_path / "work", tmp_path / "runs"
    made = asia("agent", "workspace", problem, folder, "--experiments", 4, "--runs", runs)
    assert made.code == 0, made.err
    # The baseline is judged before the folder is worked in, with a line for each step.
    lines = made.out.splitlines()
    steps = (
        "reference linear model: V = ",
        "#01, the baseline, is being evaluated",
        "#01 keep    V = ",
    )
    places = [next(i for i, line in enumerate(lines) if line.startswith(s)) for s in steps]
    assert places == sorted(places)
    assert len((folder / "results.tsv").read_text().splitlines()) == 2
    program = " ".join((folder / "PROGRAM.md").read_text().split())
    for words in ("asia try", "4 experiments", "2 blocks", "def simulate", "`u`"):
        assert words in program
    assert sorted(p.name for p in (folder / "data").iterdir()) == ["train.csv"]
    assert (folder / "data" / "train.csv").read_text().startswith("time,u,y\n0.0,")
    assert not list(folder.rglob("*test*"))

    (folder / "candidate.py").write_text("def fit(\n")
    broken = asia("try", "-m", "a typing error", "--dir", folder)
    assert broken.code == 2
    assert "cost no experiment" in broken.err
    (folder / "candidate.py").write_text(lasting(arx(2)))
    dry = asia("try", "--dry-run", "--dir", folder)
    assert dry.code == 0, dry.err
    assert "passed on 100 made-up samples" in dry.out
    assert "V" not in dry.out
    both = asia("try", "--dry-run", "--plot", "--dir", folder)
    assert both.code == 2
    assert "leave one of them out" in both.err
    without_comments = asia("try", "--dir", folder)
    assert without_comments.code == 2
    assert 'asia try -m "what you changed' in without_comments.err
    good = asia("try", "-m", "two lags", "--expect", "half", "--dir", folder, "--json")
    assert good.code == 0, good.err
    answer = json.loads(good.out)
    assert answer["experiment"] == 2
    assert answer["V"] < 0.05
    assert answer["best"] == {"experiment": 2, "V": answer["V"]}
    assert answer["remaining"] == 2
    assert answer["repeated"] is False
    assert "#02 is being evaluated" in good.err
    evidence = answer["evidence"]
    assert [fold["held_out"][:12] for fold in evidence["folds"]] == ["block 1 of 2", "block 2 of 2"]
    assert evidence["folds"][0]["errors"]["y"] == pytest.approx(answer["folds"][0])
    assert evidence["noise"] is None
    again = asia("try", "-m", "the same again", "--dir", folder / "data")
    assert again.out.startswith(
        "not evaluated again: the source equals that of #02, apart from comments."
    )
    assert "2 of 4 experiments left" in again.out
    (folder / "candidate.py").write_text(lasting(CRASH))
    dry = asia("try", "--dry-run", "--dir", folder)
    assert dry.code == 3
    assert "no such luck" in dry.out
    crash = asia("try", "-m", "a crash", "--parent", 2, "--dir", folder)
    assert crash.code == 3
    assert "no such luck" in crash.out
    # One stream keeps the order of progress and result.
    lines = crash.out.splitlines()
    result = next(i for i, line in enumerate(lines) if line.startswith("#03 crash"))
    assert lines.index("#03 is being evaluated") < result
    assert crash.err == ""
    assert "best #02" in crash.out
    (folder / "candidate.py").write_text(arx(3))
    last = asia("try", "-m", "three lags", "--plot", "--dir", folder)
    assert "picture plots/004.png" in last.out
    assert (folder / "plots" / "004-residuals.png").is_file()
    assert "against #02, the previous best; standard deviation over seeds not measured" in last.out
    assert "fold 2  block 2 of 2: samples 105 to 204 of train  V " in last.out
    assert "0 of 4 experiments left" in last.out
    assert len((folder / "results.tsv").read_text().splitlines()) == 5
    assert not os.access(folder / "results.tsv", os.W_OK) or os.geteuid() == 0
    (run,) = runs.iterdir()
    over(run)
    assert open_run(run).view.complete
    (folder / "candidate.py").write_text(arx(4))
    spent = asia("try", "-m", "one too many", "--dir", folder)
    assert spent.code == 2
    assert "the candidate was not evaluated: the budget of 4 experiments is spent" in spent.err
    (folder / "candidate.py").write_text(arx(3))
    known = asia("try", "-m", "as before", "--dir", folder)
    assert (known.code, known.out.count("not evaluated again")) == (0, 1)
    (folder / "candidate.py").write_text(arx(4))
    # The same command with more raises the budget and keeps the candidate.
    assert asia("agent", "workspace", problem, folder, "--experiments", 5, "--runs", runs).code == 0
    assert (folder / "candidate.py").read_text() == arx(4)
    more = asia("try", "-m", "one more", "--dir", folder)
    assert more.code == 0, more.err
    assert "#05" in more.out
    over(run)


@pytest.mark.parametrize("where", ["full", "inside"])
def test_a_folder_that_cannot_be_a_workspace(tmp_path: Path, asia: Asia, where: str) -> None:
    problem = write_problem(tmp_path / "toy")
    runs = tmp_path / "runs"
    folder = problem if where == "full" else runs / "toy-workspace-s0" / "work"
    done = asia("agent", "workspace", problem, folder, "--runs", runs)
    assert done.code == 2
    assert ("not empty" if where == "full" else "one contains the other") in done.err


def test_try_outside_a_workspace_says_how_to_make_one(tmp_path: Path, asia: Asia) -> None:
    done = asia("try", "-m", "anything", "--dir", tmp_path)
    assert done.code == 2
    assert "asia agent workspace PROBLEM DIR" in done.err


ASIA = "from asia.interfaces.cli import main; main()"
SLOW = "import time\n\n\ndef fit(trajectories, context):\n    time.sleep(60)\n"


@pytest.mark.long
@pytest.mark.parametrize("state", ["running", "queued"])
def test_a_search_that_dies_is_not_waited_for(tmp_path: Path, asia: Asia, state: str) -> None:
    problem = write_problem(tmp_path / "toy")
    if state == "queued":
        (problem / "baseline.py").write_text(SLOW)
    folder, runs = tmp_path / "work", tmp_path / "runs"
    options = ("--experiments", 3, "--runs", runs, "--no-start")
    assert asia("agent", "workspace", problem, folder, *options).code == 0
    (folder / "candidate.py").write_text(SLOW.replace("60", "61"))
    (run,) = runs.iterdir()
    command = [sys.executable, "-c", ASIA, "try", "-m", "a slow one", "--dir", str(folder)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True) as waiting:
        assert waiting.stderr is not None
        assert waiting.stdout is not None
        said = "#02 is being evaluated"
        if state == "queued":
            said = "#01, the baseline, is being evaluated; yours is next"
        lines: list[str] = []
        for line in waiting.stdout:
            lines.append(line.rstrip("\n"))
            if lines[-1] == said:
                break
        assert lines[-1] == said
        if state == "running":
            # This call has started the search: its references and its baseline come first.
            assert any(line.startswith("reference linear model: V = ") for line in lines)
            assert any(line.startswith("#01 keep    V = ") for line in lines)
        end_searches(run)
        last = waiting.stderr.read()
    assert waiting.returncode == 2
    when = "while" if state == "running" else "before"
    assert f"the process of the search ended {when} it evaluated the candidate" in last
    assert "repeat the command" in last
    assert last.count("\n") == 1
    assert not attended(run)


def a_folder(path: Path) -> None:
    path.mkdir()


def a_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def a_loose_link(path: Path) -> None:
    path.symlink_to("nowhere")


def nothing(path: Path) -> None:
    del path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "candidate.py: it is a named pipe"),
        (a_folder, "candidate.py: it is a folder"),
        (a_device, "candidate.py: it is a device"),
        (a_loose_link, "candidate.py, a broken link"),
        (nothing, "no such file: "),
    ],
)
def test_no_file_as_candidate(
    tmp_path: Path, asia: Asia, make: Callable[[Path], object], words: str
) -> None:
    folder = tmp_path / "work"
    problem = write_problem(tmp_path / "toy")
    options = ("--runs", tmp_path / "runs", "--no-start")
    assert asia("agent", "workspace", problem, folder, *options).code == 0
    (folder / "candidate.py").unlink()
    make(folder / "candidate.py")
    done = asia("try", "-m", "no file", "--dir", folder)
    assert done.code == 2
    assert words in done.err
    assert done.err.endswith("write the candidate there, as Python source\n")
