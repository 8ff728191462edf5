"""A search with `residuals = "held_out"`: recorded, marked everywhere, apart from those without."""

from pathlib import Path

import pytest

import asia
from asia.errors import UserError
from asia.interfaces.workspace.server import RunDesk
from asia.ledger.run import open_run
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text, protocol_digest
from asia.problem.problem import Seal
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted, arx, write_problem

SHOWN = '[protocol]\nresiduals = "held_out"\n'


def toy(directory: Path, setting: str = SHOWN) -> Path:
    write_problem(directory)
    path = directory / "problem.toml"
    path.write_text(path.read_text().replace("[protocol]\n", setting))
    return directory


@pytest.mark.slow
def test_the_setting_is_recorded_and_printed_with_v(tmp_path: Path) -> None:
    problem, agent = toy(tmp_path / "toy"), Scripted((arx(2),))
    directory = asia.run(problem, agent=agent, runs=tmp_path / "runs", experiments=2).directory
    assert directory.name == "toy-scripted-s0-residuals"
    assert 'residuals = "held_out"' in (directory / "problem.lock.toml").read_text()
    view = open_run(directory).view
    assert view.started.residuals == "held_out"
    assert view.v_name == "V (held-out residuals shown)"
    head = (directory / "results.tsv").read_text().split("\n")[0].split("\t")
    assert head[:2] == ["experiment", "val (held-out residuals shown)"]
    text = (directory / "search_journal.md").read_text()
    assert "V is with held-out residuals: " in text
    assert text.count("V (held-out residuals shown) = ") == 2
    assert load_lock(directory / "problem.lock.toml").protocol.residuals == "held_out"


@pytest.mark.slow
def test_v_carries_both_marks(tmp_path: Path) -> None:
    problem, runs = toy(tmp_path / "toy"), tmp_path / "runs"
    agent = Scripted(())
    found = asia.run(
        problem, agent=agent, runs=runs, experiments=1, early_stopping="validation"
    ).view
    assert found.v_name == "V (validation early stopping, held-out residuals shown)"


@pytest.mark.slow
def test_the_commands_say_it(tmp_path: Path) -> None:
    problem, runs = toy(tmp_path / "toy"), tmp_path / "runs"
    words = "run", problem, "--experiments", 1, "--runs", runs, "--agent", "random"
    done = command_line(*words)
    assert done.code == 0, done.err
    assert "note    V is with held-out residuals: " in done.out
    assert "V is     with held-out residuals: " in done.out
    assert "V is     with held-out residuals: " in command_line("status", "--runs", runs).out
    assert "residuals: of the held-out samples too" in command_line("check", problem).out


def test_a_protocol_without_the_setting_is_unchanged(tmp_path: Path) -> None:
    """Digests and locks of earlier versions stay as they are."""
    plain = load_problem(toy(tmp_path / "plain", "[protocol]\n"))
    said = load_problem(toy(tmp_path / "said", '[protocol]\nresiduals = "train"\n'))
    shown = load_problem(toy(tmp_path / "shown"))
    assert protocol_digest(plain) == protocol_digest(said) != protocol_digest(shown)
    assert "residuals" not in lock_text(said, Seal(None))
    digest = "8f1c29d07f631c16b885a0c8ad595a03e54ecec3"
    assert protocol_digest(plain)[:40] == digest


def test_residuals_that_there_are_not_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match='residuals is "all"'):
        load_problem(toy(tmp_path / "other", SHOWN.replace("held_out", "all")))


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["train", "held_out"])
def test_held_out_residuals_are_said_where_the_problem_shows_them(
    tmp_path: Path, setting: str
) -> None:
    """The baseline is blind to the input, so that its residual is all but notable."""
    problem = toy(tmp_path / "toy", f'[protocol]\nresiduals = "{setting}"\n')
    (problem / "baseline.py").write_text(CONSTANT)
    runs = tmp_path / "runs"
    directory = asia.run(problem, agent=Scripted(()), runs=runs, experiments=1).directory
    answer = RunDesk(directory).evidence(1)
    held_out = [line for line in answer.lines if "on the held-out samples" in line]
    assert any("on the training records" in line for line in answer.lines)
    assert bool(held_out) == bool(answer.held_out_residuals) == (setting == "held_out")


CONSTANT = """
import numpy as np


class Model:
    def simulate(self, past_u, past_y, u):
        return np.ones((*u.shape[:2], 1)) + 0.2 * u


def fit(trajectories, context):
    return Model()
"""
