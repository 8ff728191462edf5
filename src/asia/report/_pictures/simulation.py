"""Pictures of simulated outputs: held-out folds of the best experiment, and the opened test."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

from asia.data import Array, Signal, spread_of
from asia.ledger import Experiment, Run, TestedModel, Unsealed
from asia.problem.load import Problem
from asia.protocol import Fold, find_metric
from asia.report._artifacts import fold_outputs, opened_windows
from asia.report._drawing.style import number, plain, quantity, shown
from asia.report._pictures.overlay import MOST_PANELS, Heading, Panel, Piece, Words, draw_overlay
from asia.report._pictures.windows import telling
from asia.scoring import FoldScore, Score, fit_index

_MOST_SEGMENTS = 4


def draw_simulation(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Measured against simulated, a panel for each output and fold. When these are too many, the
    outputs and folds with the lowest fit index are shown, and the title says so."""
    score = experiment.score
    assert score is not None
    outputs = fold_outputs(run.store, experiment, folds)
    fits = np.array([[_order(fit) for fit in f.fit_index] for f in score.folds])
    shown_folds = lowest(fits.min(axis=1).tolist(), MOST_PANELS // 2)
    channels = lowest(worst_fits(score), MOST_PANELS // len(shown_folds))
    panels = tuple(
        Panel(
            _fold_title(problem, k, c, score.folds[k]),
            problem.outputs[c],
            _fold_segments(problem, folds[k], outputs[k], c),
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
    windows = problem.protocol.kind == "windows"
    if not windows:
        notes += shown((min(len(problem.train), _MOST_SEGMENTS), len(problem.train), "records"))
    what = "best, median and worst held-out window of each fold" if windows else "held-out folds"
    title = f"{head}: {what}, {run.view.v_name} = {number(score.value)}{notes}"
    pieces = "windows" if windows else "records"
    return draw_overlay(panels, problem.sampling_time, Words(title, "simulated", pieces=pieces))


def _order(fit: float | None) -> float:
    """An output that does not move has no fit index and comes last."""
    return np.inf if fit is None else fit


def worst_fits(score: Score) -> list[float]:
    """The lowest fit index of each output over the folds."""
    fits = [[_order(fit) for fit in f.fit_index] for f in score.folds]
    return [min(column) for column in zip(*fits, strict=True)]


def lowest(values: Sequence[float], count: int) -> list[int]:
    """Indices of the `count` lowest values, in their own order."""
    return sorted(int(i) for i in np.argsort(values, kind="stable")[: max(count, 1)])


def _fold_title(problem: Problem, fold: int, channel: int, score: FoldScore) -> Heading:
    signal, metric = problem.outputs[channel], find_metric(problem.protocol.metric)
    which = f", {plain(signal.name, 24)}" if len(problem.outputs) > 1 else ""
    error = quantity(score.per_channel(metric.name)[channel], metric.unit_of(signal.unit))
    fit = score.fit_index[channel]
    ending = "" if fit is None else f", fit {fit:.1f} %"
    return Heading(f"Fold {fold + 1}{which}", f"{plain(metric.label, 16)} {error}{ending}")


def _fold_segments(
    problem: Problem, fold: Fold, outputs: Sequence[Array], channel: int
) -> tuple[Piece, ...]:
    if problem.protocol.kind == "windows":
        return _selected_segments(problem, fold, outputs, channel)
    return tuple(
        Piece(block.case.name, block.start, block.y[:, channel], y_hat[:, channel])
        for block, y_hat in list(zip(fold.validation, outputs, strict=True))[:_MOST_SEGMENTS]
    )


def _selected_segments(
    problem: Problem, fold: Fold, outputs: Sequence[Array], channel: int
) -> tuple[Piece, ...]:
    """The windows with the least, the middle and the largest error over all outputs."""
    measured = [block.y for block in fold.validation]
    pieces: list[Piece] = []
    for word, index in telling(measured, outputs, fold.scale):
        block = fold.validation[index]
        which = f"record {block.record + 1}, " if len(problem.train) > 1 else ""
        name = f"{word}: {which}{block.start * problem.sampling_time:.3g} s"
        values = block.y[:, channel], outputs[index][:, channel]
        pieces.append(Piece(name, block.start, *values))
    return tuple(pieces)


def draw_test(run: Run, problem: Problem, opened: Unsealed, ensemble_record: TestedModel) -> Figure:
    """Measured, ensemble and refitted model over the test, a panel for each trajectory and output;
    samples that do not count are shaded. A refitted model that failed is left out."""
    if opened.horizon is not None:
        return _draw_test_windows(run, problem, opened, ensemble_record)
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    measured = run.store.get_arrays(opened.measured, shapes)
    ensemble = run.store.get_arrays(ensemble_record.y_hat, shapes)
    refitted = opened.refit if isinstance(opened.refit, TestedModel) else None
    refit = run.store.get_arrays(refitted.y_hat, shapes) if refitted else None
    edges = _edges(opened, lambda digest: run.store.get_arrays(digest, shapes))
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
                    (edges[0][i][:, c], edges[1][i][:, c]) if edges else None,
                ),
            ),
        )
        for c in channels
        for i in trajectories
    )
    title = f"Sealed test, opened once: experiment {opened.experiment}{_named(run)}"
    title += shown(
        (len(channels), len(opened.channels), "outputs"),
        (len(trajectories), len(shapes), "trajectories"),
    )
    return draw_overlay(panels, problem.sampling_time, _test_text(title, problem, opened))


def _draw_test_windows(
    run: Run, problem: Problem, opened: Unsealed, ensemble_record: TestedModel
) -> Figure:
    """The best, median and worst window of the whole test, a panel for each output; of many those
    with the lowest fit index."""
    refitted = opened.refit if isinstance(opened.refit, TestedModel) else None
    measured = opened_windows(run, opened, opened.measured)
    ensemble = opened_windows(run, opened, ensemble_record.y_hat)
    refit = opened_windows(run, opened, refitted.y_hat) if refitted else None
    edges = _edges(opened, lambda digest: opened_windows(run, opened, digest))
    fits = fit_index(np.concatenate(measured), np.concatenate(ensemble))
    channels = lowest([float(f) if np.isfinite(f) else np.inf for f in fits], MOST_PANELS)
    scale = spread_of(np.concatenate(measured))
    scale = np.where(scale > 0, scale, 1.0)
    windows = list(telling(measured, ensemble, scale))
    panels = tuple(
        Panel(
            _test_title(opened, (ensemble_record, refitted), None, c, problem.outputs[c]),
            problem.outputs[c],
            tuple(
                Piece(
                    f"{word}: window {index + 1}",
                    0,
                    measured[index][:, c],
                    ensemble[index][:, c],
                    refit[index][:, c] if refit else None,
                    band=(edges[0][index][:, c], edges[1][index][:, c]) if edges else None,
                )
                for word, index in windows
            ),
        )
        for c in channels
    )
    title = f"Sealed test, opened once: experiment {opened.experiment}{_named(run)}; best, median "
    title += "and worst of "
    title += f"{len(measured)} windows"
    title += shown((len(channels), len(opened.channels), "outputs with the lowest fit"))
    return draw_overlay(panels, problem.sampling_time, _test_text(title, problem, opened))


def _named(run: Run) -> str:
    """The model to use, where the search names one."""
    refitted = run.view.refitted
    return f", model to use: {refitted.use}" if refitted and refitted.use else ""


def _test_text(title: str, problem: Problem, opened: Unsealed) -> Words:
    folds = problem.protocol.folds.count
    names = f"ensemble of {folds} fold models", "refitted on all training data"
    pieces = "records" if opened.horizon is None else "windows"
    return Words(title, *names, pieces, _band_text(opened))


def _band_text(opened: Unsealed) -> str:
    if opened.bands is None:
        return ""
    level, held = opened.bands.level, min(opened.bands.covered)
    least = "" if len(opened.bands.covered) == 1 else "at least "
    return f"band of {level:.0%}, holds {least}{held:.0%}".replace("%", " %")


def _edges(
    opened: Unsealed, read: Callable[[str], tuple[Array, ...]]
) -> tuple[tuple[Array, ...], tuple[Array, ...]] | None:
    """Lower and upper edges of the output bands over the test, where there are any."""
    bands = opened.bands
    return None if bands is None else (read(bands.lower), read(bands.upper))


def _test_title(
    opened: Unsealed,
    records: tuple[TestedModel, TestedModel | None],
    trajectory: int | None,
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
    if isinstance(opened.stack, TestedModel):
        values.append(f"stack {number(opened.stack.scores[0].per_channel[channel])}")
    metric = find_metric(score.metric)
    unit = plain(metric.unit_of(signal.unit), 12)
    error = f"{plain(metric.label, 16)}{several} {', '.join(values)} {unit}".rstrip()
    name = "" if trajectory is None else plain(opened.trajectories[trajectory], 24)
    return Heading(f"{name or 'Test'}{which}", error)
