"""Pictures that show V say so when it is not leak-free."""

from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from asia.ledger.run import Run, open_run
from asia.problem.problem import Problem
from asia.problem.protocol import EarlyStopping
from asia.report.drawing.style import drawing
from asia.report.files import pictures

from .made_up import Shape, make_problem, write_run


def drawn(run: Run, problem: Problem) -> dict[str, Figure]:
    with drawing():
        return {name: draw() for name, draw in pictures(run, problem)}


def titles(figure: Figure) -> str:
    above = figure.get_suptitle()
    return " ".join([above, *(axes.get_title("left") for axes in figure.axes)]).replace("\n", " ")


@pytest.mark.parametrize("setting", ["inner", "validation"])
def test_titles_with_v_name_the_setting(tmp_path: Path, setting: EarlyStopping) -> None:
    problem = make_problem(Shape())
    run = open_run(write_run(tmp_path, problem, [("a first model", 0.4), ("a second", 0.3)]))
    started = replace(run.view.started, early_stopping=setting)
    found = drawn(replace(run, view=replace(run.view, started=started)), problem)
    for name in ("progress", "simulation"):
        text = titles(found[name])
        assert ("V = 0.3" in text) == (setting == "inner"), text
        assert ("V (validation early stopping) = 0.3" in text) == (setting == "validation"), text
