"""A run by the metric of an installed package: every command computes it and names it."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.interfaces.cli.conftest import Asia, Done, command_line
from tests.unit.made_up_parts import installed
from tests.unit.search.toy import write_problem

MODULE = """
import numpy as np
from asia.problem.metrics import Metric

def agreement(y, y_hat):
    return 100.0 / (1.0 + np.abs(y - y_hat).mean(axis=0))

agree = Metric("agree", "agreement", agreement, "mae", "%", "higher", 100.0)
"""
POINTS = "[asia.metrics]\nagree = made_up_agreement:agree\n"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Done, Done]]:
    """The runs directory, and what check and run printed."""
    folder = tmp_path_factory.mktemp("metric")
    problem = write_problem(folder / "toy")
    toml = problem / "problem.toml"
    text = toml.read_text()
    toml.write_text(
        text.replace("[protocol]\n", '[protocol]\nmetric = "agree"\ntest.metrics = ["agree"]\n')
    )
    with installed(folder, "made_up_agreement", MODULE, POINTS):
        checked = command_line("check", problem)
        words = ("run", problem, "--agent", "expert", "--experiments", 1, "--runs", folder / "runs")
        yield folder / "runs", checked, command_line(*words)


@pytest.mark.long
def test_a_metric_of_a_package_from_check_to_report(
    run: tuple[Path, Done, Done], asia: Asia
) -> None:
    runs, checked, ran = run
    assert checked.code == 0, checked.err
    assert "V: simulation 100 - agreement" in checked.out
    assert ran.code == 0, ran.err
    assert "V = simulation 100 - agreement" in ran.out
    shown = asia("show", "--runs", runs)
    assert "agreement y" in shown.out
    assert "RMSE" not in shown.out.partition("candidate.py")[0]
    status = json.loads(asia("status", "--runs", runs, "--json").out)
    assert status["metric"] == "agree"
    assert 0.0 < status["best"]["V"] < 50.0
    assert "metric agreement" in asia("status", "--runs", runs).out
    assert asia("report", "--runs", runs).code == 0
    test = asia("unseal", "--runs", runs, "--yes", "--yes-process")
    assert test.code == 0, test.err
    assert "agreement on the sealed test" in test.out
    assert re.search(r"\n +y +[5-9]\d\.\d+", test.out)


@pytest.mark.long
def test_without_the_package_the_run_can_still_be_looked_at(
    run: tuple[Path, Done, Done], asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.problem.metrics.parts_of", lambda group: ())
    assert "agree y" in asia("show", "--runs", run[0]).out
    report = asia("report", "--runs", run[0])
    assert report.code == 2
    assert "protocol.metric is 'agree', expected 'rmse'" in report.err
