"""The commands on a real search of one experiment."""

import json
from pathlib import Path

import pytest

from tests.unit.search.toy import write_problem

from .conftest import Asia, Searched


def test_json_lines_and_nothing_else(searched: Searched) -> None:
    printed = searched.printed
    assert printed.code == 0, printed.err
    events = [json.loads(line) for line in printed.out.splitlines()]
    kinds = [e["event"] for e in events]
    assert kinds == [
        "start", "reference", "reference", "reference", "proposed", "evaluated",
        "stopped", "refitted", "done",
    ]  # fmt: skip
    evaluated, done = events[5], events[-1]
    assert evaluated["status"] == "keep"
    assert done["best"] == {"experiment": 1, "V": evaluated["V"]}
    assert done["pictures"]
    assert all(Path(p).stat().st_size > 1000 for p in done["pictures"])


def test_same_command_again_prints_the_result(searched: Searched, asia: Asia) -> None:
    ledger = searched.directory / "ledger.jsonl"
    before = ledger.read_bytes()
    done = asia("run", searched.problem, "--agent", "random", "--experiments", 1,
                "--runs", searched.runs)  # fmt: skip
    assert done.code == 0, done.err
    # A slow machine shows its progress.
    assert all(line.startswith("run: ") for line in done.err.splitlines())
    lines = done.out.splitlines()
    assert lines[0].startswith("ASIA ")
    assert any(line.startswith("#01 keep") and "| best #01" in line for line in lines)
    assert any(line.startswith("best     #01 V=") for line in lines)
    assert any(line.endswith(".png") for line in lines)
    assert f"next     asia show {searched.directory} " in done.out
    assert f"asia unseal {searched.directory} " in done.out
    assert ledger.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("--seed", "1"), "has seed 0, not 1"),
        (("--agent", "expert"), "has agent random, not expert"),
    ],
)
def test_a_name_belongs_to_one_search(
    searched: Searched, asia: Asia, change: tuple[str, str], expected: str
) -> None:
    before = (searched.directory / "ledger.jsonl").read_bytes()
    done = asia("run", searched.problem, "--agent", "random", "--experiments", 1,
                "--runs", searched.runs, "--name", searched.name, *change)  # fmt: skip
    assert done.code == 2
    assert expected in done.err
    assert (searched.directory / "ledger.jsonl").read_bytes() == before


def test_status_json(searched: Searched, asia: Asia) -> None:
    done = asia("status", searched.name, "--runs", searched.runs, "--json")
    assert done.code == 0
    assert done.out.count("\n") == 1
    answer = json.loads(done.out)
    assert set(answer) == {
        "run", "problem", "agent", "seed", "state", "experiments", "budget", "isolation",
            "isolation_strict",
        "early_stopping", "validation_scores", "residuals", "best", "references",
        "control", "stopped", "usage", "metric", "use", "use_reason",
        "confirmed", "parallel", "running", "threshold", "remark", "incumbent", "validated",
        "error", "failed_checks",
        "alarms", "verdict", "losses", "seal", "guard", "unguarded",
    }  # fmt: skip
    assert (answer["early_stopping"], answer["validation_scores"]) == ("inner", 0)
    assert answer["problem"] == "toy"
    assert answer["state"] == "finished"
    assert answer["experiments"] == answer["budget"] == 1
    assert set(answer["best"]) == {"experiment", "V"}
    assert 0 < answer["best"]["V"] < 1
    assert answer["isolation"] in ("namespace", "landlock", "process")


def test_status_text_of_the_newest(searched: Searched, asia: Asia) -> None:
    done = asia("status", "--runs", searched.runs)
    assert done.code == 0
    assert "run toy-random-s0  problem toy  agent random  seed 0" in done.out
    assert "finished: 1 of 1 experiments" in done.out
    assert "reference models:" in done.out
    assert "linear model" in done.out
    assert "#01 keep" in done.out


def test_runs_may_come_from_the_environment(
    searched: Searched, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASIA_RUNS", str(searched.runs))
    assert "run toy-random-s0" in asia("status").out


@pytest.mark.slow
def test_unseal_once(searched: Searched, asia: Asia) -> None:
    words = ("unseal", searched.name, "--runs", searched.runs)
    unasked = asia(*words)
    assert unasked.code == 2
    assert "--yes" in unasked.err
    assert json.loads(asia("status", "--runs", searched.runs, "--json").out)["state"] == "finished"
    first = asia(*words, "--yes", "--yes-process", "--json")
    assert first.code == 0, first.err
    assert "already" not in first.err
    answer = json.loads(first.out)
    assert set(answer) == {
        "test", "experiment", "skip", "refit", "use", "early_stopping", "residuals", "bands",
        "alarms", "opened_before",
    }  # fmt: skip
    assert set(answer["bands"]) == {"model", "level", "covered", "outside"}
    assert set(answer["bands"]["covered"]) == {"y"}
    for model in ("test", "refit"):
        assert set(answer[model]) == {"rmse", "per_channel", "per_trajectory"}
        assert set(answer[model]["per_channel"]) == {"y"}
        assert set(answer[model]["per_trajectory"]) == {"test"}
        assert answer[model]["rmse"] == pytest.approx(answer[model]["per_channel"]["y"])
    again = asia(*words, "--json")
    assert again.code == 0
    assert again.out == first.out
    assert "the test of this run is open already" in again.err
    text = asia(*words)
    assert "RMSE on the sealed test" in text.out
    assert f"{answer['test']['rmse']:.4f}" in text.out
    assert "picture" in text.out
    state = json.loads(asia("status", "--runs", searched.runs, "--json").out)["state"]
    assert state == "unsealed"
    more = asia("run", searched.problem, "--agent", "random", "--experiments", 2,
                "--runs", searched.runs)  # fmt: skip
    assert more.code == 2
    assert "unsealed" in more.err


def test_show(searched: Searched, asia: Asia) -> None:
    done = asia("show", searched.name, "--runs", searched.runs)
    assert done.code == 0
    for words in ("#01 baseline", "hypothesis", "decision    keep", "RMSE y", "def fit("):
        assert words in done.out
    assert asia("show", "--runs", searched.runs).out == done.out
    assert asia("show", "1", "--runs", searched.runs).out == done.out
    source = asia("show", "1", "--source", "--runs", searched.runs)
    assert source.out == (searched.problem / "baseline.py").read_text()


def test_diff(searched: Searched, asia: Asia) -> None:
    done = asia("show", "1", "1", "--runs", searched.runs)
    assert done.code == 0
    assert done.out.count("#01 baseline: V = ") == 2
    assert "@@" not in done.out


def test_verify(searched: Searched, asia: Asia) -> None:
    done = asia("verify", "--runs", searched.runs)
    assert done.code == 0
    assert "8 events and" in done.out
    artifact = next((searched.directory / "artifacts").iterdir())
    artifact.write_bytes(artifact.read_bytes() + b" ")
    broken = asia("verify", "--runs", searched.runs)
    assert broken.code == 2
    assert str(artifact) in broken.err


def test_report(searched: Searched, asia: Asia) -> None:
    done = asia("report", "--runs", searched.runs)
    assert done.code == 0
    paths = [Path(line) for line in done.out.splitlines()]
    assert {p.suffix for p in paths} >= {".png", ".pdf"}
    assert all(p.is_file() for p in paths)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("show", "99"), "has no experiment 99; it has 1 to 1"),
        (("show", "toy-random-s0", "one"), "expected [RUN] [N [M]]"),
        (("show", "1", "1", "1"), "expected [RUN] [N [M]]"),
        (("show", "1", "2"), "has no experiment 2"),
        (("status", "other"), "no run 'other'"),
    ],
)
def test_what_is_not_there(
    searched: Searched, asia: Asia, words: tuple[str, ...], expected: str
) -> None:
    done = asia(*words, "--runs", searched.runs)
    assert done.code == 2
    assert done.out == ""
    assert expected in done.err


def test_check_draws_the_data(problem: Path, asia: Asia, tmp_path: Path) -> None:
    done = asia("check", "toy")
    assert done.code == 0, done.err
    assert "fold 2: holds out train" in done.out
    pictures = [Path(line.split()[1]) for line in done.out.splitlines() if "picture" in line]
    assert pictures
    assert all((tmp_path / p).is_file() for p in pictures)


def test_version(asia: Asia) -> None:
    from asia import __version__

    assert asia("--version").out == f"asia {__version__}\n"


@pytest.mark.long
def test_strict_isolation_is_told(tmp_path: Path, asia: Asia) -> None:
    problem = write_problem(tmp_path / "toy")
    words = ("--agent", "random", "--experiments", 1, "--runs", tmp_path / "runs")
    found = asia("run", problem, *words, "--isolation-strict")
    assert found.code == 0, found.err
    assert ", strict" in found.out.splitlines()[0]
    run = tmp_path / "runs" / "toy-random-s0"
    assert ", strict" in asia("status", run).out.splitlines()[0]
    assert json.loads(asia("status", run, "--json").out)["isolation_strict"] is True
    assert ", strict" in asia("show", run, "1").out


@pytest.mark.long
def test_where_the_seconds_went(searched: Searched, asia: Asia, tmp_path: Path) -> None:
    done = asia("status", searched.directory, "--profile")
    assert done.code == 0, done.err
    table = done.out[done.out.index("profile ") :].splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in table[1:]}
    assert float(rows["references"][0]) > 0
    assert rows["pictures"] == ["not", "recorded"]
    told = json.loads(asia("status", searched.directory, "--profile", "--json").out)["profile"]
    # Workers that were started ahead may cost next to no wall time.
    assert told["workers"]["wall"] + told["workers"]["processor"] > 0
    assert float(rows["total"][0]) == round(sum(one["wall"] for one in told.values()), 2)

    begun = asia("run", searched.problem, "--agent", "random", "--experiments", 1,
                 "--runs", tmp_path, "--profile")  # fmt: skip
    assert begun.code == 0, begun.err
    table = begun.out[begun.out.index("profile ") :].splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in table[1:]}
    assert float(rows["pictures"][0]) > 0
    assert float(rows["prepare"][0]) > 0


def test_an_old_ledger_has_no_seconds_to_show(asia: Asia) -> None:
    old = Path(__file__).parents[3] / "golden/0.1.0/runs/finished"
    done = asia("status", old, "--profile")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1].startswith("profile  not recorded")
