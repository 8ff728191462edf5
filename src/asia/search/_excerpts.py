"""A bounded part of what an experiment's models simulate, made anew from the stored models in the
sandbox: no ledger has to hold it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia._text import one_line
from asia.data import Array
from asia.errors import CandidateError, UserError
from asia.evaluation import Evaluator
from asia.ledger import Experiment, Run
from asia.problem.load import load_lock
from asia.protocol import Block, Fold, ProtocolRule, cut, whole
from asia.report import SimulatedCase, SimulatedCases, simulated_cases
from asia.search._run import LOCK, make_evaluator

_MOST_RECORDS = 4
_MOST_SAMPLES = 4000
_MOST_WINDOWS = 24
_MOST_VALUES = 400_000
_TITLE = 200


def simulated_excerpts(run: Run, number: int) -> SimulatedCases:
    """Training cases of each fold of experiment `number` and, where the problem shows residuals of
    the held-out part, held-out ones. Raises UserError where it has no models."""
    experiment = run.view.experiment(number)
    result, score = experiment.result, experiment.score
    if result is None or score is None:
        raise UserError(f"experiment {number} has no score, so there is nothing to draw")
    problem = load_lock(run.directory / LOCK)
    evaluator = make_evaluator(problem, run.view)
    parts = (1 + (problem.protocol.residuals == "held_out")) * len(evaluator.folds)
    most = _MOST_VALUES // parts // (2 * len(problem.outputs) + len(problem.inputs))
    cases: list[SimulatedCase] = []
    for index, fold in enumerate(evaluator.folds):
        blocks = training_excerpt(fold, problem.protocol, most)
        y_hat = _simulated(run, evaluator, experiment, index, blocks)
        cases += simulated_cases(fold, blocks, y_hat, held_out=False)
        if problem.protocol.residuals == "held_out":
            shapes = [block.y.shape for block in fold.validation]
            stored = run.store.get_arrays(result.folds[index].y_hat, shapes)
            places = _spread(fold.validation, problem.protocol, most)
            chosen = [fold.validation[k] for k in places], [stored[k] for k in places]
            cases += simulated_cases(fold, *chosen, held_out=True)
    return SimulatedCases(
        title=f"Experiment {number}, {_title(experiment)}",
        sampling_time=problem.sampling_time,
        windows=problem.protocol.horizon is not None,
        inputs=problem.inputs,
        outputs=problem.outputs,
        cases=tuple(cases),
    )


def _title(experiment: Experiment) -> str:
    """The whole hypothesis where the title is its beginning, up to a few lines."""
    title, hypothesis = experiment.proposed.title, experiment.proposed.hypothesis
    whole = hypothesis.startswith(title.removesuffix("…"))
    return one_line(hypothesis if whole else title, _TITLE)


def training_excerpt(fold: Fold, rule: ProtocolRule, most: int = _MOST_SAMPLES) -> list[Block]:
    """Some cases of the records that a fold trains on, of `most` samples in all."""
    if rule.horizon is not None:
        blocks = whole(fold.train, rule)
        return [blocks[k] for k in _spread(blocks, rule, most)]
    records = fold.train[:_MOST_RECORDS]
    each = min(most // len(records), _MOST_SAMPLES)
    return [
        cut(record, rule.past, min(len(record), rule.past + each), rule, k)
        for k, record in enumerate(records)
    ]


def _spread(blocks: Sequence[Block], rule: ProtocolRule, most: int) -> list[int]:
    """Return the indices of the chosen blocks: some windows, evenly spaced, or the first complete
    records.
    """
    if rule.horizon is None:
        ends = np.cumsum([len(block.y) for block in blocks[:_MOST_RECORDS]])
        return list(range(max(1, int((ends <= most).sum()))))
    count = max(1, min(_MOST_WINDOWS, most // rule.horizon, len(blocks)))
    return np.unique(np.linspace(0, len(blocks) - 1, count).round().astype(int)).tolist()


def _simulated(
    run: Run, evaluator: Evaluator, experiment: Experiment, index: int, blocks: Sequence[Block]
) -> tuple[Array, ...]:
    assert experiment.result is not None
    source = run.store.text(experiment.proposed.source)
    model = run.store.get(experiment.result.folds[index].model)
    try:
        return evaluator.simulate(source, [model], blocks)[0]
    except CandidateError as error:
        raise UserError(
            f"the model of fold {index + 1} cannot be simulated again: {error.reason.advice}"
        ) from None
