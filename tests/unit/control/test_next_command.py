"""asia next and asia extend on a finished search."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import asia as library
from asia.agents.leading import LeadingAgent, LeadingCandidate, leading_settings
from asia.agents.registry import recorded_agent
from asia.control.commands.next_experiment import _kept, _named, _span  # pyright: ignore[reportPrivateUsage]
from asia.errors import UserError
from asia.ledger.run import open_run
from asia.search.extension import extended_problem, leading_experiments
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import painted
from tests.unit.search.toy import Scripted, arx, write_problem


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A search in which #02 and #03, of second and third order, are far better than #01."""
    root = tmp_path_factory.mktemp("finished")
    problem = write_problem(root / "toy")
    return library.run(
        problem, agent=Scripted((arx(2), arx(3))), runs=root / "runs", experiments=3
    ).directory


@pytest.fixture(scope="module")
def proposed(searched: Path) -> dict[str, object]:
    with painted():
        done = command_line(
            "next", searched, "--duration", 30, "--limits", "u=-2..2", "--rate", "u=4", "--keep",
            "y<4", "--keep", "y>-4", "--start", "u=0",
        )  # fmt: skip
    assert done.code == 0, done.err
    return {"out": done.out, "folder": searched / "next"}


@pytest.mark.slow
def test_the_record_holds_limits_and_rate(proposed: dict[str, object]) -> None:
    folder = Path(str(proposed["folder"]))
    text = (folder / "next.csv").read_text()
    assert text.startswith("time,u\n")
    t, u = np.loadtxt(folder / "next.csv", delimiter=",", skiprows=1).T
    assert t == pytest.approx(0.5 * np.arange(60))
    assert np.abs(u).max() <= 2.0
    assert np.abs(np.diff(u, prepend=0.0)).max() <= 2.0 + 1e-9
    assert u.std() > 0.3
    facts = json.loads((folder / "next.json").read_text())
    record = facts["records"]["proposed"]
    assert -4.0 <= record["lower"][0] < record["upper"][0] <= 4.0
    assert record["expected_error"] < facts["expected_error"]
    assert sorted(facts["experiments"]) == [2, 3]
    assert (folder / "next.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_text_compares_with_records_of_equal_energy(proposed: dict[str, object]) -> None:
    out = str(proposed["out"])
    assert re.search(r"fold models of #0[23] and of other candidates: #0[23]\n", out)
    assert "start     at rest: u 0; y " in out
    assert "inside its limits" in out
    assert "proposed       APRBS   multisine" in out
    assert "expected error of the model on inputs within the limits" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--duration is missing"),
        (("--duration", 30, "--limits", "v=0..1"), "one of u"),
        (("--duration", 30, "--limits", "u=3..1"), "expected LOW..HIGH"),
        (("--duration", 30, "--keep", "y=3"), "expected a limit such as"),
        (("--duration", 30, "--rate", "u=-1"), "expected positive numbers"),
        (("--duration", 2), "4 samples: expected at least 12"),
        (("--duration", 30, "--limits", "u=5..6"), "give wider --limits"),
    ],
)
def test_wrong_options_are_named(
    finished_once: Path, words: tuple[object, ...], message: str
) -> None:
    done = command_line("next", finished_once / "runs" / "toy-scripted-s0", *words)
    assert done.code == 2
    assert message in done.err


def test_options_name_their_signals() -> None:
    assert _named("--limits", ["0..10"], ["flow"], "u") == [("flow", "0..10", "--limits 0..10")]
    several = _named("--start", ["flow=1,heat=2", "a,b=3"], ["flow", "heat", "a,b"], "u")
    with pytest.raises(UserError, match="weather is a disturbance, which nobody sets"):
        _named("--limits", ["weather=0..10"], ["flow"], "u", ["weather"])
    assert [pair[:2] for pair in several] == [("flow", "1"), ("heat", "2"), ("a,b", "3")]
    assert _span("x", "-1e-3..2") == (-1e-3, 2.0)
    assert _kept(["level<9", "level > 1"], ["level", "flow"]) == {"level": (1.0, 9.0)}
    assert _kept(["y<=9"], ["level"]) == {"level": (-np.inf, 9.0)}
    with pytest.raises(UserError, match="leave nothing"):
        _kept(["y<1", "y>2"], ["y"])


def write_record(path: Path, gain: float = 1.0) -> Path:
    """A new record of the toy system."""
    rng = np.random.default_rng(7)
    u = rng.normal(size=120)
    y = np.zeros(120)
    for k in range(2, 120):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + gain * (0.4 * u[k] + 0.2 * u[k - 1])
    np.savetxt(path, np.stack([u, y], axis=1), delimiter=",", header="u,y", comments="")
    return path


@pytest.mark.slow
def test_leading_experiments_begin_with_the_best(searched: Path) -> None:
    view = open_run(searched).view
    assert view.best is not None
    best, second = view.best.number, 5 - view.best.number
    # The baseline is of another family, so it comes before the second of the same one.
    assert [e.number for e in leading_experiments(view, 3, 1e9)] == [best, 1, second]
    assert [e.number for e in leading_experiments(view, 3, 2.0)] == [best, second]
    assert [e.number for e in leading_experiments(view, 1, 1e9)] == [best]


def test_the_copy_has_one_record_more_and_the_old_run_stays(finished: Path, tmp_path: Path) -> None:
    record = write_record(tmp_path / "new.csv")
    before = {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()}
    run = open_run(finished)
    problem, notes = extended_problem(run, record, tmp_path / "more")
    assert notes == ()
    assert [len(t) for t in problem.train] == [240, 120]
    assert problem.train[1].name == "new"
    assert problem.test.source is not None
    assert problem.baseline == (finished.parents[1] / "toy" / "baseline.py").read_text()
    assert {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()} == before
    again, _ = extended_problem(run, record, tmp_path / "more")
    assert [len(t) for t in again.train] == [240, 120]
    write_record(record, gain=2.0)
    with pytest.raises(UserError, match="holds another problem"):
        extended_problem(run, record, tmp_path / "more")
    taken = write_record(tmp_path / "train.csv")
    with pytest.raises(UserError, match="rename the new file"):
        extended_problem(run, taken, tmp_path / "other")


@pytest.mark.slow
def test_extend_begins_with_the_leading_candidate(
    searched: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(
        "class Silent:\n    name = 'silent'\n\n    def propose(self, view):\n        return None\n"
    )
    record = write_record(tmp_path / "new.csv")
    words = (
        "extend", searched, record, "--agent", "own:Silent", "--experiments", 4, "--retests", 0,
        "--out", tmp_path / "more", "--runs", tmp_path / "runs", "--name", "longer",
    )  # fmt: skip
    done = command_line(*words)
    assert done.code == 0, done.err
    assert re.search(r"before    the old model \(\w+ of #0[23]\) has V=0\.\d+ on new.csv", done.out)
    old = open_run(searched).view
    view = open_run(tmp_path / "runs" / "longer").view
    assert old.best is not None
    assert view.experiments[1].proposed.digest == old.best.proposed.digest
    assert view.experiments[1].proposed.hypothesis.startswith("It led an earlier search")
    assert view.best is not None
    assert view.best.number in (2, 3)
    assert (view.started.agent, view.started.agent_settings["then"]) == ("leading", "silent")
    assert command_line(*words).code == 0
    ahead = command_line(*("two" if word == "longer" else word for word in words), "--parallel", 2)
    assert ahead.code == 2
    assert "the agent silent proposes one experiment at a time" in ahead.err
    few = command_line(*(2 if word == 4 else word for word in words))
    assert few.code == 2
    assert "give --experiments 3 or more" in few.err


def test_a_ledger_has_all_that_the_agent_needs() -> None:
    one = LeadingCandidate("arx", "second order", arx(2), "run #02, V 0.1")
    again = recorded_agent("leading", leading_settings([one], "random", {}))
    assert isinstance(again, LeadingAgent)
    assert again.candidates == (one,)
    assert again.following.name == "random"
    # Candidates that somebody submits after them cannot be asked for again.
    assert recorded_agent("leading", leading_settings([one], "claude", {})) is None
