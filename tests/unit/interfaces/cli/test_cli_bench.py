"""asia bench agents on the toy problem, one experiment a search."""

import json
from pathlib import Path

import pytest

from asia.interfaces.cli import spread
from asia.interfaces.cli.bench import _v_table  # pyright: ignore[reportPrivateUsage]
from tests.unit.search.toy import arx

from .conftest import Asia


@pytest.fixture(autouse=True)
def _without_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linear reference by the toy's own least squares, so that nothing is compiled."""
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))


@pytest.mark.long
def test_bench_prints_its_tables_and_goes_on(problem: Path, asia: Asia, tmp_path: Path) -> None:
    words = ("bench", "agents", problem, "--agents", "expert,random",
             "--experiments", 1, "--seeds", 1, "--runs", tmp_path / "runs")  # fmt: skip
    done = asia(*words)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert "[1/2] compare-toy-expert-inner-s0" in lines
    titles = [line for line in lines if line.startswith("## ")]
    assert "inner" in titles[0]
    assert titles[1] == "## Paired by seed"
    document = tmp_path / "runs" / "compare-toy-inner" / "comparison.md"
    assert f"tables   {document}" in lines
    assert all(title in document.read_text() for title in titles)
    again = asia(*words, "--json")
    assert again.code == 0, again.err
    events = [json.loads(line) for line in again.out.splitlines()]
    assert [e["event"] for e in events] == ["run", "run", "done"]
    assert set(events[0]) == {"event", "run", "agent", "seed", "experiments", "V"}
    assert {row["model"] for row in events[-1]["rows"]} > {"expert, best of 1", "linear model"}
    assert [Path(path).name for path in events[-1]["pictures"]] == [
        "comparison.png", "comparison.pdf",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--early-stopping", "none"), "expected inner or validation"),
        (("--seeds", "0"), "expected how many seeds"),
        (("--seeds", "1", "1"), "needs every seed once"),
        (("--agents", "expert,expert"), "needs every agent once"),
        (("--agents", "exprt"), "no agent 'exprt'"),
    ],
)
def test_what_cannot_be_compared(
    problem: Path, asia: Asia, words: tuple[str, ...], expected: str
) -> None:
    done = asia("bench", "agents", problem, *words)
    assert done.code == 2
    assert not done.out
    assert expected in done.err


def test_lists_of_seeds() -> None:
    words = ["bench", "agents", "nanodrone", "--seeds", "0", "1", "--agents=expert", "--json"]
    assert spread(words) == [
        "bench", "agents", "nanodrone", "--seeds", "0", "--seeds", "1", "--agents=expert",
        "--json",
    ]  # fmt: skip


@pytest.mark.parametrize("shown", [True, False])
def test_shown_held_out_residuals_are_in_the_title(shown: bool) -> None:
    table = _v_table((), (), validation=False, shown=shown)
    assert ("agents saw residuals of the held-out folds" in table) is shown
