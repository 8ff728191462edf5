"""A search on windows with groups of records, to the table of the opened test."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from asia.ledger.events import TestedModel as Record
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from asia.search.scores import ScoreCheck
from asia.search.simulation import simulate
from asia.search.unsealing import unseal
from tests.unit.interfaces.cli.conftest import command_line

from .toy import Scripted

HOLD = """
import numpy as np


class Hold:
    def simulate(self, past_u, past_y, u):
        return np.repeat(past_y[:, -1:], u.shape[1], axis=1)


def fit(trajectories, context):
    assert context.horizon == 10
    return Hold()
"""
TOML = """
name = "turns"
sampling_time = 0.1
inputs = ["u"]
outputs = ["p", "roll", "pitch", "yaw"]
[data]
train = ["a1.csv", "a2.csv", "b1.csv"]
test = ["t1.csv", "t2.csv"]
[data.groups]
a = ["a*"]
b = ["b1"]
[protocol]
kind = "windows"
horizon = 10
folds = { kind = "leave_one_group_out" }
past_inputs = 0
past_outputs = 1
metric = "mae"
[protocol.test]
metrics = ["mae", "mee"]
horizons = [1, 10]
[protocol.test.groups]
p = ["p"]
R = { roll_pitch_yaw = ["roll", "pitch", "yaw"] }
[budget]
experiments = 1
fit_seconds = 60
"""


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished search whose best candidate holds the last output."""
    root = tmp_path_factory.mktemp("windows")
    problem = root / "turns"
    problem.mkdir()
    rng = np.random.default_rng(0)
    for name, length in (("a1", 60), ("a2", 55), ("b1", 41), ("t1", 47), ("t2", 31)):
        u = rng.normal(size=length)
        y = 0.1 * np.cumsum(rng.normal(size=(length, 4)), axis=0)
        table = np.concatenate([u[:, None], y], axis=1)
        header = "u,p,roll,pitch,yaw"
        np.savetxt(problem / f"{name}.csv", table, delimiter=",", header=header, comments="")
    (problem / "problem.toml").write_text(TOML)
    (problem / "baseline.py").write_text(HOLD)
    ready = prepare(load_problem(problem), "scripted", seed=0, runs=root / "runs")
    search(ready, Scripted(()), lambda event, view: None, lambda view: None)
    return ready.directory


@pytest.fixture
def run(searched: Path, tmp_path: Path) -> Path:
    """A copy of its directory, to unseal."""
    shutil.copytree(searched.parent.parent, tmp_path / "copy")
    return tmp_path / "copy" / "runs" / searched.name


def measured(run: Path) -> list[np.ndarray]:
    """The test windows of both records, start by start."""
    folder = run.parent.parent / "turns"
    found: list[np.ndarray] = []
    for name, starts in (("t1", (1, 11, 21, 31, 37)), ("t2", (1, 11, 21))):
        y = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1)[:, 1:]
        found += [y[k - 1 : k + 10] for k in starts]
    return found


@pytest.mark.slow
def test_unsealing_gives_the_table(run: Path) -> None:
    record = unseal(run, process_consent=True).record
    check = ScoreCheck(run)
    verify(run, check=check)
    assert (check.experiments, check.tested) == (1, 2)
    assert (record.horizon, record.skip, record.lengths) == (10, 0, (50, 30))
    assert record.trajectories == ("t1", "t2")
    for model in (record.ensemble, record.refit):
        assert isinstance(model, Record)
        assert [score.metric for score in model.scores] == ["mae"]
        windows = measured(run)
        errors = np.concatenate([np.abs(w[1:] - w[0]) for w in windows])
        assert model.scores[0].per_channel == pytest.approx(errors.mean(axis=0))
        assert model.scores[0].per_trajectory == pytest.approx(
            (errors[:50].mean(), errors[50:].mean())
        )
        assert model.mee is not None
        p, attitude = model.mee.groups
        steps = np.mean([np.abs(w[1:, 0] - w[0, 0]) for w in windows], axis=0)
        assert p.steps == pytest.approx(tuple(steps))
        assert (attitude.name, len(attitude.steps)) == ("R", 10)
    again = open_run(run).view.unsealed
    assert again == record


@pytest.mark.long
def test_the_command_line_prints_the_table(run: Path) -> None:
    done = command_line("unseal", run, "--yes", "--yes-process", "--json")
    assert done.code == 0, done.err
    test = json.loads(done.out)["test"]
    assert list(test["mee"]) == ["p", "R"]
    assert list(test["mee"]["R"]) == ["h1", "h10", "sum"]
    first = np.mean([abs(w[1, 0] - w[0, 0]) for w in measured(run)])
    assert test["mee"]["p"]["h1"] == pytest.approx(first)
    text = command_line("unseal", run).out
    assert "windows of 10 samples" in text
    head = next(line for line in text.splitlines() if line.strip().startswith("group"))
    assert head.split() == ["group", "h1", "h10", "sum"]
    row = next(line for line in text.splitlines() if line.split()[:1] == ["p"])
    assert float(row.split()[1]) == pytest.approx(first, rel=1e-3)


@pytest.mark.long
def test_the_best_candidate_simulates_windows_and_longer(run: Path) -> None:
    for length in (10, 25):
        y_hat = simulate(run, np.zeros((0, 1)), np.ones((1, 4)), np.zeros((length, 1)))
        assert np.array_equal(y_hat, np.ones((length, 4)))
        banded = simulate(run, np.zeros((0, 1)), np.ones((1, 4)), np.zeros((length, 1)), bands=0.8)
        assert np.array_equal(banded.y_hat, y_hat)
        # Bands of two outputs did not hold their share of the folds, and are withdrawn.
        given = ~np.isnan(banded.lower[0])
        assert 0 < np.sum(given) < 4
        lower, upper = banded.lower[:, given], banded.upper[:, given]
        assert np.all(lower <= y_hat[:, given])
        assert np.all(upper[10:] - lower[10:] <= upper[9] - lower[9])
