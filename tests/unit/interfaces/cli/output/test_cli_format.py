import io
from dataclasses import replace

import pytest

from asia._timer import duration
from asia.interfaces.cli.output import Terminal
from asia.interfaces.cli.show import describe
from asia.judge.scoring.outcome import Score
from asia.ledger.events import Fit, Status
from asia.ledger.run import open_run
from asia.ledger.view import Experiment
from asia.presentation.experiments import experiment_line
from asia.presentation.table import error_value
from tests.unit.interfaces.cli.conftest import Searched


def test_numbers() -> None:
    assert [error_value(v) for v in (0.13104, 12.5, 6.5e35)] == ["0.1310", "12.5000", "6.50e+35"]
    assert [duration(s) for s in (6.6, 185.0, 3720.0)] == ["7s", "3m05s", "1h02m"]


@pytest.mark.long
def test_a_simulation_that_ran_away_keeps_to_its_column(searched: Searched) -> None:
    view = open_run(searched.directory).view
    (experiment,) = view.finished
    assert experiment.score
    assert experiment.result
    usual = experiment_line(experiment, view)
    folds = tuple(replace(f, value=6.5e35, fit_index=(-1e38,)) for f in experiment.score.folds)
    far = replace(experiment, result=replace(experiment.result, outcome=Score(6.5e35, folds)))
    assert "V=6.50e+35" in experiment_line(far, view)
    assert len(experiment_line(far, view)) - len(usual) <= 2


def test_v_stands_beside_v_and_a_mean_beside_a_mean(searched: Searched) -> None:
    view = open_run(searched.directory).view
    (one,) = view.finished
    assert one.score
    assert one.result

    def made(number: int, status: Status, values: tuple[float, ...], lowest: bool) -> Experiment:
        assert one.score
        assert one.result
        result = replace(
            one.result, status=status, outcome=Score(values[0], one.score.folds), lowest=lowest,
            retests=tuple(Fit(7, "retest", value) for value in values[1:]),
        )  # fmt: skip
        return Experiment(replace(one.proposed, experiment=number), result)

    found = (
        made(1, "keep", (0.2, 0.21, 0.22), True),
        made(2, "inconclusive", (0.089,), True),
        made(3, "keep", (0.125, 0.126, 0.127), False),
        made(4, "discard", (0.3,), False),
    )
    view = replace(view, experiments=found)
    lines = [experiment_line(e, view) for e in found]
    ends = [line.partition(" | ")[2] for line in lines]
    assert ends == [
        "mean of 3 seeds 0.2100 | best #01 0.2000, lowest mean of seeds #01 0.2100",
        "best #02 0.0890, lowest mean of seeds #01 0.2100",
        "mean of 3 seeds 0.1260 | best #02 0.0890, lowest mean of seeds #03 0.1260",
        "best #02 0.0890, lowest mean of seeds #03 0.1260",
    ]
    assert lines[2].startswith("#03 keep    V=0.1250 ")
    plain = replace(view, experiments=(made(1, "keep", (0.2,), False),))
    assert experiment_line(plain.finished[0], plain).endswith(" | best #01 0.2000")


def test_brackets_of_an_agent_are_shown_as_they_are(searched: Searched) -> None:
    run = open_run(searched.directory)
    (experiment,) = run.view.finished
    words = "[bold]clip[/] x[0] to [0, 1]"
    bracketed = replace(
        experiment, proposed=replace(experiment.proposed, title=words, hypothesis=words)
    )
    console = Terminal(file=io.StringIO(), width=200)
    describe(console, run, bracketed)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count(words) == 2


def test_a_score_far_below_the_training_error_is_doubted(searched: Searched) -> None:
    run = open_run(searched.directory)
    (experiment,) = run.view.finished
    assert experiment.score
    low = replace(
        experiment,
        result=replace(experiment.result, outcome=Score(1e-6, experiment.score.folds)),
    )
    texts: list[str] = []
    for one in (experiment, low):
        console = Terminal(file=io.StringIO(), width=200)
        describe(console, run, one)
        assert isinstance(console.file, io.StringIO)
        texts.append(console.file.getvalue())
    assert "V divided by the training error: " in texts[0]
    assert "suspiciously low" not in texts[0]
    assert "0.00, suspiciously low; V was the same when" in texts[1]
