"""Seeds and folds in the output of `tools.py`."""

import sys
from pathlib import Path

import pytest

from asia.interfaces.workspace.tools import WorkspaceTools, main
from asia.interfaces.workspace.workspace import write_folder
from asia.judge.sandbox.layers.environment import REPEATABLE
from asia.problem.load import load_problem
from tests.unit.search.toy import write_problem

DRAWN = """import numpy as np

class Model:
    def __init__(self, level):
        self.level = level

    def simulate(self, past_u, past_y, u):
        return np.full((*u.shape[:2], past_y.shape[2]), self.level)

def fit(trajectories, context):
    return Model(np.random.default_rng(context.seed).normal())
"""


def test_another_seed_draws_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in REPEATABLE.items():
        monkeypatch.setenv(name, value)
    folder = tmp_path / "work"
    write_folder(folder, load_problem(write_problem(tmp_path / "toy")), 3)
    (folder / "candidate.py").write_text(DRAWN)
    tools = WorkspaceTools(folder, seed=0)

    def first_line(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["tools.py", *words])
        with pytest.raises(SystemExit):
            main(tools)
        return capsys.readouterr().out.splitlines()[0]

    assert first_line() == first_line("--seed", "0") != first_line("--seed", "1")
    ((record, _), _) = tools.evaluate()
    assert repr(record).startswith("<V ")
    assert len(repr(record)) < 80
