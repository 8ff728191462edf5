"""Pictures of simulations in many short windows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure

from asia.data import Array
from asia.ledger import Experiment, Run, TestedModel, Unsealed
from asia.problem.load import Problem
from asia.protocol import Fold, OutputGroup
from asia.report._artifacts import fold_outputs, opened_windows
from asia.report._comparison import PublishedMee
from asia.report._drawing.style import plain, shown
from asia.report._pictures.growth import MOST_PANELS, ErrorCurve, Growth, Marks, draw_growth
from asia.scoring import mee_table


def telling(
    measured: Sequence[Array], simulated: Sequence[Array], scale: Array
) -> Iterator[tuple[str, int]]:
    """The windows with the least, the middle and the largest error, by their index. The error is
    the mean of |error| / scale over samples and outputs; measured, simulated: (H, ny) a window,
    scale (ny,)."""
    pairs = zip(measured, simulated, strict=True)
    errors = np.array([_mean_error(y - y_hat, scale) for y, y_hat in pairs])
    order = np.argsort(errors, kind="stable")
    places = {"best": 0, "median": len(order) // 2, "worst": len(order) - 1}
    seen: set[int] = set()
    for word, place in places.items():
        index = int(order[place])
        if index not in seen:
            seen.add(index)
            yield word, index


def _mean_error(error: Array, scale: Array) -> float:
    """Over what was measured; 0 where nothing was."""
    sizes = (np.abs(error) / scale)[~np.isnan(error)] if np.isnan(error).any() else None
    if sizes is None:
        return float(np.mean(np.abs(error) / scale))
    return float(np.mean(sizes)) if sizes.size else 0.0


def draw_horizon(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Mean error after each sample of the held-out windows, a panel for each output group (for
    each output where the problem names no groups) and a line for each fold; see `mee_table`."""
    outputs = fold_outputs(run.store, experiment, folds)
    groups = output_groups(problem)
    lines: dict[str, list[ErrorCurve]] = {group.name: [] for group in groups}
    for fold, y_hat in zip(folds, outputs, strict=True):
        table = mee_table([b.y for b in fold.validation], y_hat, _names(problem), groups, ())
        for error in table.groups:
            lines[error.name].append(ErrorCurve(_fold_name(problem, fold), np.array(error.steps)))
    panels = tuple(
        Growth(group.name, distance_label(problem, group), tuple(lines[group.name]))
        for group in groups
    )
    title = f"Experiment {experiment.number}, {plain(experiment.proposed.title, 40)}: error over "
    title += f"the horizon, held-out folds{_left_out(problem)}"
    return draw_growth(panels, problem.sampling_time, title)


def draw_test_horizon(
    run: Run,
    problem: Problem,
    opened: Unsealed,
    ensemble: TestedModel,
    published: Sequence[PublishedMee] = (),
    caption: str = "",
) -> Figure:
    """Mean error after each sample of the test windows, a panel for each output group: ensemble,
    refitted model and published errors, which `caption` explains."""
    groups = output_groups(problem)
    models = [(f"ensemble of {problem.protocol.folds.count} fold models", ensemble)]
    if isinstance(opened.refit, TestedModel):
        models.append(("refitted on all training data", opened.refit))
    measured = opened_windows(run, opened, opened.measured)
    lines: dict[str, list[ErrorCurve]] = {group.name: [] for group in groups}
    for label, model in models:
        y_hat = opened_windows(run, opened, model.y_hat)
        for error in mee_table(measured, y_hat, _names(problem), groups, ()).groups:
            lines[error.name].append(ErrorCurve(label, np.array(error.steps)))
    panels = tuple(
        Growth(
            group.name,
            distance_label(problem, group),
            tuple(lines[group.name]),
            tuple(Marks(p.model, _points(p, group.name)) for p in published),
        )
        for group in groups
    )
    title = f"Sealed test, opened once: experiment {opened.experiment}, error over the horizon, "
    title += f"{len(measured)} windows{_left_out(problem)}"
    return draw_growth(panels, problem.sampling_time, title, caption)


def _points(published: PublishedMee, group: str) -> tuple[tuple[int, float], ...]:
    return tuple((h, value) for name, h, value in published.errors if name == group)


def output_groups(problem: Problem) -> tuple[OutputGroup, ...]:
    """Those of the test table, or every output by itself, `MOST_PANELS` at most."""
    single = tuple(OutputGroup(s.name, (s.name,)) for s in problem.outputs)
    return (problem.protocol.test.groups or single)[:MOST_PANELS]


def distance_label(problem: Problem, group: OutputGroup) -> str:
    """The kind of distance and its unit, where the outputs of the group share one."""
    units = {s.unit for s in problem.outputs if s.name in group.outputs}
    unit = f" [{units.pop()}]" if len(units) == 1 and units != {""} else ""
    if group.distance == "geodesic":
        return f"Angle{unit}"
    return f"{'Distance' if len(group.outputs) > 1 else 'Error'}{unit}"


def _names(problem: Problem) -> list[str]:
    return [s.name for s in problem.outputs]


def _fold_name(problem: Problem, fold: Fold) -> str:
    groups = problem.protocol.folds.groups
    held_out = f", {groups[fold.index].name}" if groups else ""
    return f"fold {fold.index + 1}{held_out}: {len(fold.validation)} windows"


def _left_out(problem: Problem) -> str:
    if problem.protocol.test.groups:
        return ""
    return shown((min(len(problem.outputs), MOST_PANELS), len(problem.outputs), "outputs"))
