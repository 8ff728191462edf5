"""asia bench paper on the toy problem, one experiment a search."""

import json
from pathlib import Path

import pytest

from asia.interfaces.cli import spread
from tests.unit.search.toy import arx

from .conftest import Asia


@pytest.fixture(autouse=True)
def _without_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linear reference by the toy's own least squares, so that nothing is compiled."""
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))


@pytest.mark.long
def test_bench_prints_its_tables_and_goes_on(problem: Path, asia: Asia, tmp_path: Path) -> None:
    words = ("bench", "paper", problem, "--arms", "expert",
             "--experiments", 1, "--seeds", 1, "--runs", tmp_path / "runs")  # fmt: skip
    done = asia(*words)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0] == (
        "bench toy: 2 searches, 2 experiments, seeds 0, early stopping inner, validation"
    )
    titles = [line for line in lines if line.startswith("## ")]
    assert "inner" in titles[0]
    assert "not leak-free" in titles[1]
    document = tmp_path / "runs" / "bench-toy" / "toy.md"
    assert f"tables   {document}" in lines
    assert all(title in document.read_text() for title in titles)
    assert any(line.startswith("sealed   the test of bench-toy-expert-inner-s0") for line in lines)
    again = asia(*words, "--json")
    assert again.code == 0, again.err
    events = [json.loads(line) for line in again.out.splitlines()]
    assert [e["event"] for e in events] == ["run", "run", "done"]
    assert set(events[0]) == {
        "event", "run", "arm", "early_stopping", "seed", "experiments", "V",
    }  # fmt: skip
    assert events[-1]["test"] is None
    opened = asia(*words, "--json", "--unseal")
    assert opened.code == 0, opened.err
    test = json.loads(opened.out.splitlines()[-1])["test"]
    assert test["run"] == "bench-toy-expert-inner-s0"
    assert set(test["ensemble"]) == {"rmse"}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--early-stopping", "none"), "expected inner, validation or both"),
        (("--seeds", "0"), "expected how many seeds"),
        (("--seeds", "1", "1"), "needs every seed once"),
        (("--arms", "expert", "llm"), "no arm 'llm'; there is: expert, random, random-paper"),
        (("--quick", "--unseal"), "--unseal with --quick"),
        (("--arms", "random", "--unseal"), "no run was declared"),
    ],
)
def test_what_cannot_be_compared(
    problem: Path, asia: Asia, words: tuple[str, ...], expected: str
) -> None:
    done = asia("bench", "paper", problem, *words)
    assert done.code == 2
    assert done.out.count("\n") <= 1
    assert expected in done.err


def test_an_unknown_problem(asia: Asia) -> None:
    done = asia("bench", "paper", "cascaded-tank")
    assert done.code == 2
    assert "cascaded_tanks" in done.err


def test_lists_of_seeds_and_arms() -> None:
    words = [
        "bench",
        "paper",
        "nanodrone",
        "--seeds",
        "0",
        "1",
        "--arms=expert",
        "random",
        "--quick",
    ]
    assert spread(words) == [
        "bench", "paper", "nanodrone", "--seeds", "0", "--seeds", "1", "--arms=expert", "--arms",
        "random", "--quick",
    ]  # fmt: skip
