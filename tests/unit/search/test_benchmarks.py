"""Public benchmarks on made-up files of the published layout: checked, searched, opened."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partialmethod
from pathlib import Path

import pytest

from asia.agents import AgentView, Proposal
from asia.agents.expert.agent import ExpertAgent
from asia.data.sources import Channels, Source, SourceData, Subset
from asia.data.sources.official import PublishedFile
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.official_data import WRITERS
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import painted, unpainted

# Of all records that a search has, and of each at least, which is more than a past window.
SAMPLES, LEAST = 2000, 160


@pytest.fixture(scope="module", autouse=True)
def unpainted_pictures() -> Iterator[None]:
    with unpainted():
        yield


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of made-up files, which no digest refuses."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(PublishedFile, "is_digest", lambda self, found: True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


class Brisk(ExpertAgent):
    """The expert, which plans for short fits."""

    def propose(self, view: AgentView) -> Proposal | None:
        budget = replace(view.facts.budget, fit_seconds=10.0)
        return super().propose(replace(view, facts=replace(view.facts, budget=budget)))


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


# Of the last two, an experiment takes two minutes: the baseline and one more.
@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "experiments"),
    [
        ("ced", 4), ("emps", 4), ("bouc_wen", 4), ("silverbox", 4), ("wiener_hammerstein", 4),
        ("f16", 4), ("fine_steering_mirror", 2), ("parallel_wiener_hammerstein", 2),
    ],
)  # fmt: skip
def test_each_is_checked_searched_and_opened(
    name: str, experiments: int, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole files are checked; the search has the start of each record, to be quick."""
    if name in WRITERS:
        WRITERS[name](files)
    with painted():
        done = command_line("check", name)
    assert done.code == 0, done.err
    assert "test: " in done.out
    monkeypatch.setattr(Source, "records", partialmethod(first_samples, Source.records))
    problem = load_problem(name)
    problem = replace(problem, budget=replace(problem.budget, experiments=experiments))
    ready = prepare(problem, "expert", seed=0, runs=files / "runs")
    view = search(ready, Brisk(), lambda *_: None, lambda _: None)
    assert len(view.finished) == experiments
    assert view.best is not None
    assert view.best.score is not None
    assert view.best.score.value < 0.9
    assert view.unsealed is None
    if name == "ced":
        opened = command_line("unseal", ready.directory, "--yes", "--yes-process")
        assert opened.code == 0, opened.err
        lines = opened.out.splitlines()
        assert lines[-1].startswith("submit   RMSE [")
        for figure in ("low", "high"):
            assert any(line.startswith(f"official {figure}") for line in lines)
