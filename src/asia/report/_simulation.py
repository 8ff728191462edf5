"""Pictures of simulated outputs: held-out folds of the best experiment, and the opened test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from asia.ledger import Experiment, Run, Store, TestRecord, Unsealed
from asia.problem import Array, Signal
from asia.problem.load import Problem
from asia.protocol import Fold
from asia.report._overlay import MOST_PANELS, Heading, Panel, Piece, Words, draw_overlay
from asia.report._style import number, plain, quantity, shown
from asia.scoring import FoldScore

_MOST_PIECES = 4


def fold_outputs(
    store: Store, experiment: Experiment, folds: Sequence[Fold]
) -> tuple[tuple[Array, ...], ...]:
    """Simulated held-out blocks (H, ny) of each fold, as the search recorded them."""
    assert experiment.result is not None
    return tuple(
        store.get_arrays(record.y_hat, [b.y.shape for b in fold.validation])
        for record, fold in zip(experiment.result.folds, folds, strict=True)
    )


def draw_simulation(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Measured against simulated, a panel for each output and fold. When these are too many, the
    outputs and folds with the lowest fit index are shown, and the title says so."""
    score = experiment.score
    assert score is not None
    outputs = fold_outputs(run.store, experiment, folds)
    fits = np.array([[_order(fit) for fit in f.fit_index] for f in score.folds])
    shown_folds = _lowest(fits.min(axis=1).tolist(), MOST_PANELS // 2)
    room = MOST_PANELS // len(shown_folds)
    channels = _lowest(fits.min(axis=0).tolist(), room)
    panels = tuple(
        Panel(
            _fold_title(k, c, problem.outputs, score.folds[k]),
            problem.outputs[c],
            _fold_pieces(folds[k], outputs[k], c),
        )
        for c in channels
        for k in shown_folds
    )
    head = f"Experiment {experiment.number}, {plain(experiment.proposed.title, 40)}"
    notes = shown(
        (len(shown_folds), len(folds), "folds"),
        (len(channels), len(problem.outputs), "outputs"),
        why="shown, the lowest fit",
    )
    notes += shown((min(len(problem.train), _MOST_PIECES), len(problem.train), "records"))
    title = f"{head}: held-out folds, V = {number(score.value)}{notes}"
    return draw_overlay(panels, problem.sampling_time, Words(title, "simulated"))


def _order(fit: float | None) -> float:
    """An output that does not move has no fit index and comes last."""
    return np.inf if fit is None else fit


def _lowest(values: Sequence[float], count: int) -> list[int]:
    """Indices of the `count` lowest values, in their own order."""
    return sorted(int(i) for i in np.argsort(values, kind="stable")[: max(count, 1)])


def _fold_title(fold: int, channel: int, outputs: Sequence[Signal], score: FoldScore) -> Heading:
    signal = outputs[channel]
    which = f", {plain(signal.name, 24)}" if len(outputs) > 1 else ""
    error = quantity(score.rmse[channel], signal.unit)
    fit = score.fit_index[channel]
    ending = "" if fit is None else f", fit {fit:.1f} %"
    return Heading(f"Fold {fold + 1}{which}", f"RMSE {error}{ending}")


def _fold_pieces(fold: Fold, outputs: Sequence[Array], channel: int) -> tuple[Piece, ...]:
    return tuple(
        Piece(block.case.name, block.start, block.y[:, channel], y_hat[:, channel])
        for block, y_hat in list(zip(fold.validation, outputs, strict=True))[:_MOST_PIECES]
    )


def draw_test(run: Run, problem: Problem, opened: Unsealed, ensemble_record: TestRecord) -> Figure:
    """Measured, ensemble and refitted model over the test, a panel for each trajectory and output;
    samples that do not count are shaded. A refitted model that failed is left out."""
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    measured = run.store.get_arrays(opened.measured, shapes)
    ensemble = run.store.get_arrays(ensemble_record.y_hat, shapes)
    refitted = opened.refit if isinstance(opened.refit, TestRecord) else None
    refit = run.store.get_arrays(refitted.y_hat, shapes) if refitted else None
    channels = range(min(len(opened.channels), MOST_PANELS))
    trajectories = range(min(len(shapes), max(1, MOST_PANELS // len(channels))))
    panels = tuple(
        Panel(
            _test_title(opened, (ensemble_record, refitted), i, c, problem.outputs[c]),
            problem.outputs[c],
            (
                Piece(
                    opened.trajectories[i],
                    problem.protocol.past,
                    measured[i][:, c],
                    ensemble[i][:, c],
                    refit[i][:, c] if refit else None,
                    opened.skip,
                ),
            ),
        )
        for c in channels
        for i in trajectories
    )
    title = f"Sealed test, opened once: experiment {opened.experiment}"
    title += shown(
        (len(channels), len(opened.channels), "outputs"),
        (len(trajectories), len(shapes), "trajectories"),
    )
    return draw_overlay(panels, problem.sampling_time, _test_words(title, problem, opened))


def _test_words(title: str, problem: Problem, opened: Unsealed) -> Words:
    folds = problem.protocol.folds.count
    return Words(title, f"ensemble of {folds} fold models", "refitted on all training data")


def _test_title(
    opened: Unsealed,
    records: tuple[TestRecord, TestRecord | None],
    trajectory: int,
    channel: int,
    signal: Signal,
) -> Heading:
    ensemble, refitted = records
    score = ensemble.scores[0]
    which = f", {plain(signal.name, 24)}" if len(opened.channels) > 1 else ""
    several = f" ({len(opened.lengths)} trajectories)" if len(opened.lengths) > 1 else ""
    values = [f"ensemble {number(score.per_channel[channel])}"]
    if refitted:
        values.append(f"refit {number(refitted.scores[0].per_channel[channel])}")
    unit = plain(signal.unit, 12)
    error = f"{score.metric.upper()}{several} {', '.join(values)} {unit}".rstrip()
    return Heading(f"{plain(opened.trajectories[trajectory], 24) or 'Test'}{which}", error)
