"""Findings of an evaluation for each fold besides its score."""

from pathlib import Path

import numpy as np
import pytest

from asia.judge.evaluation.evaluator import Evaluation
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Score
from asia.ledger.view import replay
from asia.problem.folds import fold_names, make_folds
from asia.problem.load import load_problem
from asia.search.run import make_evaluator, prepare
from tests.unit.search.toy import arx, write_problem

NAMED = arx(2).replace(
    "    def simulate(",
    "    def parameters(self):\n        return {'first': self.weights[0, 0]}\n\n    def simulate(",
)
PRINTING = NAMED.replace("    context.log(", "    print('loss', 0.5)\n    context.log(")
SPEAKING = PRINTING.replace("        n = 2\n", "        n = 2\n        print('held out', past_y)\n")


def evaluated(root: Path, source: str, residuals: str = "train") -> Evaluation:
    directory = write_problem(root / "toy")
    path = directory / "problem.toml"
    path.write_text(
        path.read_text().replace("[protocol]", f'[protocol]\nresiduals = "{residuals}"')
    )
    problem = load_problem(directory)
    ready = prepare(problem, "scripted", seed=0, runs=root / "runs", isolation=Isolation.PROCESS)
    return make_evaluator(problem, replay([ready.started])).evaluate(source)


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return evaluated(tmp_path_factory.mktemp("found"), SPEAKING)


def test_errors_of_the_outputs_average_to_the_score(evaluation: Evaluation) -> None:
    assert isinstance(evaluation.outcome, Score)
    for fold in evaluation.folds:
        assert np.mean(fold.errors) == pytest.approx(fold.value, rel=1e-12)
        train = fold.diagnostics.train_error
        assert np.mean(fold.train_errors) == pytest.approx(train, rel=1e-12)
        assert fold.steps == ()


def test_each_fold_names_its_parameters_and_its_residuals(evaluation: Evaluation) -> None:
    for findings in evaluation.folds:
        ((name, value),) = findings.parameters
        assert name == "first"
        assert value == pytest.approx(1.2, abs=0.1)
        assert findings.residuals
        assert findings.compile_seconds == 0.0
        assert findings.numbers == 5  # weights of two outputs and three inputs
        assert findings.sample_seconds is not None
        assert findings.sample_seconds > 0.0


def test_a_fit_is_heard_and_a_simulation_of_held_out_cases_is_not(evaluation: Evaluation) -> None:
    assert [findings.printed for findings in evaluation.folds] == ["loss 0.5\n"] * 2


def test_held_out_residuals_are_found_only_where_the_problem_shows_them(
    evaluation: Evaluation, tmp_path: Path
) -> None:
    shown = evaluated(tmp_path, NAMED, "held_out")
    for hidden, findings in zip(evaluation.folds, shown.folds, strict=True):
        assert hidden.held_out_residuals == ()
        assert findings.held_out_residuals != ()
        assert findings.held_out_residuals != findings.residuals


def test_a_fit_that_fails_is_heard(tmp_path: Path) -> None:
    failing = PRINTING.replace("    return Model(weights)", "    raise ValueError('no')")
    found = evaluated(tmp_path, failing)
    assert found.folds == ()
    assert found.output == "loss 0.5\n"


def test_folds_are_named_by_their_held_out_samples(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    folds = make_folds(problem.train, problem.protocol)
    names = fold_names(folds, problem.protocol)
    assert names == (
        "block 1 of 2: samples 4 to 122 of train", "block 2 of 2: samples 123 to 240 of train",
    )  # fmt: skip
