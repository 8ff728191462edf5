"""A benchmark of the suite on made-up files of the published layout: checked, then searched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partialmethod
from pathlib import Path

import pytest

from asia.agents import AgentView, Proposal
from asia.agents.expert.agent import ExpertAgent
from asia.data.sources import Channels, Source, SourceData, Subset
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.official_data import WRITERS
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import painted

# Of all records that a search has, and of each at least, which is more than a past window.
SAMPLES, LEAST = 2000, 160


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


def check_and_search(
    name: str, files: Path, monkeypatch: pytest.MonkeyPatch, experiments: int = 4
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
