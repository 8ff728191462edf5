"""Output of the commands about a search with validation early stopping."""

import json
from pathlib import Path

import pytest

from tests.unit.search.toy import arx, write_problem

from .conftest import Asia, Searched, command_line

pytestmark = pytest.mark.slow

TOLD = arx(1).replace(
    "    return Model(weights)\n",
    "    if context.validation_score is not None:\n"
    "        context.validation_score(Model(weights))\n"
    "    return Model(weights)\n",
)
CALLED = "V (validation early stopping)"


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Searched:
    root = tmp_path_factory.mktemp("validation")
    problem = write_problem(root / "toy")
    (problem / "baseline.py").write_text(TOLD)
    printed = command_line(*words(problem, root / "runs"))
    return Searched(printed, problem, root / "runs", "toy-random-s0-validation")


def words(problem: Path, runs: Path) -> tuple[object, ...]:
    return (
        "run", problem, "--agent", "random", "--experiments", 1, "--runs", runs,
        "--early-stopping", "validation",
    )  # fmt: skip


def test_run_says_it_at_the_start_on_every_line_and_at_the_end(told: Searched) -> None:
    assert told.printed.code == 0, told.printed.err
    lines = told.printed.out.splitlines()
    assert "run toy-random-s0-validation" in lines[0]
    assert f"{CALLED} = normalised simulation RMSE" in lines[1]
    assert "not leak-free" in lines[2]
    row = next(line for line in lines if line.startswith("#01"))
    assert "| 2 validation scores " in row
    assert "| best #01" in row
    end = next(line for line in lines if line.startswith("V is"))
    assert end.endswith("; 2 validation scores were given")


def test_json_lines_say_it(told: Searched) -> None:
    again = command_line(*words(told.problem, told.runs), "--json")
    events = [json.loads(line) for line in again.out.splitlines()]
    assert events[0]["early_stopping"] == events[-1]["early_stopping"] == "validation"
    assert events[-1]["validation_scores"] == 2


def test_status_says_it(told: Searched, asia: Asia) -> None:
    text = asia("status", "--runs", told.runs).out
    assert "V is     with validation early stopping: " in text
    assert "; 2 validation scores were given" in text
    assert "| 2 validation scores " in text
    answer = json.loads(asia("status", "--runs", told.runs, "--json").out)
    assert answer["early_stopping"] == "validation"
    assert answer["validation_scores"] == 2


def test_show_and_diff_say_it(told: Searched, asia: Asia) -> None:
    text = asia("show", "--runs", told.runs).out
    assert f"result      {CALLED} = " in text
    assert "2 validation scores)" in text
    assert asia("show", "1", "1", "--runs", told.runs).out.count(f"{CALLED} = ") == 2
