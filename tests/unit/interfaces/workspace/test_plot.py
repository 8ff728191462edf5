"""Pictures of an experiment in a workspace: what is simulated again, and how much of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asia.errors import UserError
from asia.interfaces.workspace.server import DeskServer, RunDesk, SocketDesk
from asia.interfaces.workspace.workspace import Workspace
from asia.ledger.run import open_run
from asia.ledger.simulated import SimulatedCases
from asia.problem.folds import make_folds
from asia.problem.held_back import GUARD_SHARE
from asia.problem.load import load_problem
from asia.problem.protocol import ProtocolRule
from asia.search.simulation import training_excerpt
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem


def searched(root: Path, setting: str = "[protocol]\n") -> Path:
    """The directory of a run: experiment 2 is better than the baseline, 3 crashes."""
    import asia

    problem = write_problem(root / "toy") / "problem.toml"
    problem.write_text(problem.read_text().replace("[protocol]\n", setting))
    agent = Scripted((arx(2), CRASH))
    return asia.run(problem.parent, agent=agent, runs=root / "runs", experiments=3).directory


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return searched(tmp_path_factory.mktemp("plain"))


@pytest.mark.slow
def test_training_samples_alone_are_simulated(run: Path) -> None:
    shown = RunDesk(run).simulated(2)
    problem = load_problem(run.parents[1] / "toy", GUARD_SHARE)
    folds = make_folds(problem.train, problem.protocol)
    assert [(fold, held_out) for fold, held_out, _ in shown.cases] == [(1, False), (2, False)]
    for (_, _, case), fold in zip(shown.cases, folds, strict=True):
        y, y_hat = case.y, case.y_hat
        assert np.array_equal(y, fold.train[0].y[3:])
        assert np.sqrt(np.mean((y - y_hat) ** 2)) < 0.05
        record = problem.train[0].y
        assert np.array_equal(y, record[case.start : case.start + len(y)])


@pytest.mark.long
def test_held_out_samples_are_shown_where_the_problem_says_so(tmp_path: Path) -> None:
    directory = searched(tmp_path, '[protocol]\nresiduals = "held_out"\n')
    shown = RunDesk(directory).simulated(2)
    assert [(fold, held_out) for fold, held_out, _ in shown.cases] == [
        (1, False), (1, True), (2, False), (2, True),
    ]  # fmt: skip
    view = open_run(directory).view
    score = view.experiment(2).score
    assert score is not None
    for (_, _, case), fold in zip(shown.cases[1::2], score.folds, strict=True):
        assert np.sqrt(np.mean((case.y - case.y_hat) ** 2)) == pytest.approx(fold.rmse[0])


@pytest.mark.slow
def test_what_has_no_score_is_not_drawn(run: Path) -> None:
    with pytest.raises(UserError, match="experiment 3 has no score"):
        RunDesk(run).simulated(3)


@pytest.mark.long
def test_pictures_lie_in_the_folder(run: Path, tmp_path: Path) -> None:
    with DeskServer(tmp_path / "s", RunDesk(run)):
        shown = SocketDesk(tmp_path / "s").simulated(2)
    assert isinstance(shown, SimulatedCases)
    for sent, made in zip(shown.cases, RunDesk(run).simulated(2).cases, strict=True):
        assert sent[:2] == made[:2]
        assert sent[2].start == made[2].start
        assert np.array_equal(sent[2].y_hat, made[2].y_hat)
    (tmp_path / "work").mkdir()
    names = Workspace(tmp_path / "work", None).draw(2, shown)
    assert names == ("plots/002.png", "plots/002-residuals.png")
    for name in names:
        assert (tmp_path / "work" / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("horizon", [None, 20])
def test_long_records_are_cut(horizon: int | None) -> None:
    from asia.data import Trajectory

    kind = "simulation" if horizon is None else "windows"
    rule = ProtocolRule(kind=kind, horizon=horizon)
    y = np.sin(np.arange(60_000.0))
    fold = make_folds([Trajectory(y, y, 1.0, "long")], rule)[0]
    blocks = training_excerpt(fold, rule, 3000)
    assert sum(len(block.y) for block in blocks) <= 3000
    few = training_excerpt(fold, rule)
    assert sum(len(block.y) for block in few) <= 4000
    assert {block.record for block in blocks} == {0}
