"""The suite on made-up files of the published layout."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partialmethod
from pathlib import Path

import pytest

from asia.agents import AgentView, ExpertAgent, Proposal
from asia.bench.suite import SUITE, select_problems
from asia.data.sources import Channels, Source, SourceData, Subset
from asia.data.sources.official.files import PublishedFile
from asia.errors import UserError
from asia.problem.load import load_problem
from asia.search import prepare, search
from tests.official_data import WRITERS
from tests.unit.cli.conftest import command_line
from tests.unit.painting import painted

# Of all records that a search has, and of each at least, which is more than a past window.
SAMPLES, LEAST = 2000, 160


class Brisk(ExpertAgent):
    """The expert, which plans for short fits."""

    def propose(self, view: AgentView) -> Proposal | None:
        budget = replace(view.facts.budget, fit_seconds=10.0)
        return super().propose(replace(view, facts=replace(view.facts, budget=budget)))


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where made-up files belong, which no digest refuses."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(PublishedFile, "is_digest", lambda self, found: True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


def first_samples(
    source: Source,
    whole: Callable[[Source, Subset, Channels], SourceData],
    subset: Subset,
    channels: Channels,
) -> SourceData:
    """The first samples of each record, fewer where there are many records."""
    found = whole(source, subset, channels)
    few = max(LEAST, SAMPLES // len(found.trajectories))
    truth = None if found.truth is None else tuple(y[:few] for y in found.truth)
    return replace(found, trajectories=tuple(t[:few] for t in found.trajectories), truth=truth)


def test_benchmarks_are_chosen_by_name_in_the_order_of_the_suite() -> None:
    assert select_problems(None) == SUITE
    assert select_problems("silverbox, wiener-hammerstein,ced") == (
        "ced",
        "silverbox",
        "wiener_hammerstein",
    )
    with pytest.raises(UserError, match="did you mean 'silverbox'"):
        select_problems("silverboks")
    with pytest.raises(UserError, match="names no benchmark"):
        select_problems(" ,")


def test_benchmarks_without_data_are_left_out(files: Path) -> None:
    done = command_line("bench", "suite", "--only", "ced,emps", "--runs", files / "runs", "--json")
    assert done.code == 0
    found = json.loads(done.out.splitlines()[-1])["suite"]
    assert all("not on this machine" in found[name]["left_out"] for name in ("ced", "emps"))


def test_options_that_do_not_go_together(files: Path) -> None:
    for words in (("suite", "--quick"), ("ced", "--only", "ced")):
        done = command_line("bench", *words, "--runs", files / "runs")
        assert done.code == 2
        assert "leave" in done.err


@pytest.mark.slow
@pytest.mark.parametrize("name", [*WRITERS, "bouc_wen"])
def test_each_benchmark_is_checked_and_searched(
    name: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole files are checked; the search has the start of each record, to be quick."""
    if name in WRITERS:
        WRITERS[name](files)
    with painted():
        done = command_line("check", name)
    assert done.code == 0, done.err
    assert "test, sealed" in done.out
    monkeypatch.setattr(Source, "records", partialmethod(first_samples, Source.records))
    problem = load_problem(name)
    problem = replace(problem, budget=replace(problem.budget, experiments=4))
    ready = prepare(problem, "expert", seed=0, runs=files / "runs")
    view = search(ready, Brisk(), lambda *_: None, lambda _: None)
    assert len(view.finished) == 4
    assert view.best is not None
    assert view.best.score is not None
    assert view.best.score.value < 0.9
    assert view.unsealed is None


@pytest.mark.slow
def test_the_suite_searches_resumes_and_opens_only_when_asked(files: Path) -> None:
    WRITERS["ced"](files)
    words = ("bench", "suite", "--only", "ced,emps", "--experiments", 1, "--runs", files / "runs")
    done = command_line(*words)
    assert done.code == 0, done.err
    assert "sealed" in done.out
    assert "emps was left out" in done.out
    assert (files / "runs" / "bench-suite" / "boards.png").is_file()
    ledger = next((files / "runs").glob("bench-ced*/ledger.jsonl"))
    before = ledger.read_bytes()
    again = command_line(*words)
    assert ledger.read_bytes() == before
    assert again.out.splitlines()[-8:] == done.out.splitlines()[-8:]
    opened = command_line(*words, "--unseal", "--yes-process", "--json")
    assert opened.code == 0, opened.err
    figures = json.loads(opened.out.splitlines()[-1])["suite"]["ced"]["figures"]
    assert list(figures) == ["low", "high"]
    assert all(math.isfinite(f["value"]) and f["among"] == 23 for f in figures.values())
    told = command_line("unseal", ledger.parent.name, "--yes", "--runs", files / "runs")
    assert told.out.splitlines()[-1].startswith("submit   RMSE [")
    assert any(line.startswith("official low") for line in told.out.splitlines())
