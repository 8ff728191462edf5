"""Pictures of simulated outputs, of long records and of windows."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from asia.data.trajectory import Array, Signal, spread_of
from asia.judge.scoring.outcome import FoldScore, fit_index, mee_table
from asia.ledger.events import TestedModel, Unsealed
from asia.ledger.run import Run
from asia.ledger.view import Experiment
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.problem.protocol import Fold, OutputGroup
from asia.report.comparison import PublishedMee
from asia.report.drawing.places import Stretch, TimeAxis, last_sample, lay_out, time_unit
from asia.report.drawing.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    SHADE,
    PlotWithStrip,
    arrange,
    axis_label,
    entitle,
    figure_legend,
    headline,
    number,
    picture_width,
    plain,
    quantity,
    quiet_grid,
    shown,
)
from asia.report.simulated import fold_outputs, lowest, opened_windows, telling, worst_fits

# Measured against simulated outputs, the error in a strip below.


MOST_PANELS = 8
_SINGLE_COLUMN = 3
_MANY_SAMPLES = 20_000
_BAND = 0.2


@dataclass(frozen=True)
class Piece:
    """One segment of a record.

    Attributes:
        measured, simulated: outputs (H,).
        other: a second simulation (H,).
        start: index of its first sample in the record.
        skip: number of first samples that do not count.
        band: lower and upper edges (H,) of the output bands.
    """

    name: str
    start: int
    measured: Array
    simulated: Array
    other: Array | None = None
    skip: int = 0
    band: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class Heading:
    """Title of a panel: what it shows, and its error in words."""

    what: str
    error: str

    def lines(self, width: int) -> str:
        """Return the text, on one line if `width` characters hold it."""
        line = f"{self.what}:  {self.error}"
        return line if len(line) <= width else f"{self.what}\n{self.error}"


@dataclass(frozen=True)
class Panel:
    """One output over one or several segments."""

    heading: Heading
    signal: Signal
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class Words:
    """Title of the picture, names of the curves and of the bands, and what the pieces of a panel
    are."""

    title: str
    simulated: str
    other: str = ""
    pieces: str = "records"
    band: str = ""


def draw_overlay(panels: Sequence[Panel], sampling_time: float, words: Words) -> Figure:
    """A panel each, in two columns when there are many. sampling_time in seconds."""
    columns = 1 if len(panels) <= _SINGLE_COLUMN else 2
    width = picture_width() if columns == 1 else 1.45 * picture_width()
    figure = Figure()
    cells: list[PlotWithStrip] = []
    for index, (panel, axis) in enumerate(
        zip(panels, _time_axes(panels, sampling_time, words.pieces), strict=True)
    ):
        plot = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        strip = figure.add_axes((0.0, 0.0, 1.0, 1.0), sharex=plot)
        _curves(plot, panel, axis, 90 if columns == 1 else 72)
        _errors(strip, panel, axis)
        title = panel.heading.lines(80 if columns == 1 else 56)
        plot.set_title(title)
        plot.tick_params(axis="x", labelbottom=False, length=0)
        if index >= len(panels) - columns:
            strip.set_xlabel(axis.label)
        cells.append(PlotWithStrip(plot, strip, title.count("\n") + 1))
    _legend(figure, panels, words)
    arrange(figure, cells, columns, width, headline(words.title, width))
    return figure


def _time_axes(panels: Sequence[Panel], sampling_time: float, pieces: str) -> list[TimeAxis]:
    segments = [[Stretch(p.start, len(p.measured)) for p in panel.pieces] for panel in panels]
    unit = time_unit(sampling_time * max(last_sample(s) for s in segments))
    return [lay_out(s, sampling_time, unit, pieces) for s in segments]


def _curves(axes: Axes, panel: Panel, axis: TimeAxis, characters: int) -> None:
    raster = sum(len(p.measured) for p in panel.pieces) > _MANY_SAMPLES
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.band is not None:
            axes.fill_between(time, *piece.band, color=BLUE, alpha=_BAND, lw=0, rasterized=raster)
        axes.plot(time, piece.measured, color=FAINT, lw=2.6, rasterized=raster)
        if piece.other is not None:
            axes.plot(time, piece.other, color=ORANGE, lw=0.9, dashes=(4, 1.5), rasterized=raster)
        axes.plot(time, piece.simulated, color=BLUE, lw=1.1, rasterized=raster)
    axes.set_ylabel(axis_label(panel.signal))
    _dress(axes, panel, axis)
    if len(panel.pieces) > 1:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.15 * (high - low))
        for piece, time in zip(panel.pieces, axis.times, strict=True):
            _name_piece(axes, piece.name, time, characters // len(panel.pieces))


def _name_piece(axes: Axes, name: str, time: Array, room: int) -> None:
    axes.annotate(
        plain(name, max(room, 4)),
        xy=(float(time[0]), 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(2.0, -1.0),
        textcoords="offset points",
        va="top",
        fontsize=7.0,
        color=QUIET,
    )


def _errors(axes: Axes, panel: Panel, axis: TimeAxis) -> None:
    raster = sum(len(p.measured) for p in panel.pieces) > _MANY_SAMPLES
    axes.axhline(0.0, color=QUIET, lw=0.7)
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.other is not None:
            error = piece.measured - piece.other
            axes.plot(time, error, color=ORANGE, lw=0.7, dashes=(4, 1.5), rasterized=raster)
        if piece.band is not None:
            low, high = (edge - piece.simulated for edge in piece.band)
            axes.fill_between(time, low, high, color=BLUE, alpha=_BAND, lw=0, rasterized=raster)
        axes.plot(time, piece.measured - piece.simulated, color=BLUE, lw=0.9, rasterized=raster)
    unit = plain(panel.signal.unit, 8)
    axes.set_ylabel(f"error\n[{unit}]" if unit else "error", fontsize=7.5)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, symmetric=True))
    _dress(axes, panel, axis)


def _dress(axes: Axes, panel: Panel, axis: TimeAxis) -> None:
    quiet_grid(axes)
    axes.set_xlim(*axis.limits)
    for seam in axis.seams:
        axes.axvline(seam, color=QUIET, lw=0.8, dashes=(2, 2))
    for piece, time in zip(panel.pieces, axis.times, strict=True):
        if piece.skip > 0:
            axes.axvspan(time[0], time[min(piece.skip, len(time) - 1)], color=SHADE, lw=0, zorder=0)


def _legend(figure: Figure, panels: Sequence[Panel], words: Words) -> None:
    pieces = [piece for panel in panels for piece in panel.pieces]
    axes = figure.axes[0]
    handles = [
        axes.plot([], [], color=FAINT, lw=2.6, label="measured")[0],
        axes.plot([], [], color=BLUE, lw=1.1, label=words.simulated)[0],
    ]
    if any(p.other is not None for p in pieces):
        handles += axes.plot([], [], color=ORANGE, lw=0.9, dashes=(4, 1.5), label=words.other)
    shaded: list[Artist] = []
    if any(p.band is not None for p in pieces):
        shaded += axes.fill([np.nan], [np.nan], color=BLUE, alpha=_BAND, lw=0, label=words.band)
    if any(p.skip for p in pieces):
        shaded += axes.fill([np.nan], [np.nan], color=SHADE, label="left out of the error")
    columns = 3 if len(handles) + len(shaded) > 4 else 4
    figure_legend(
        figure, [*handles, *shaded], columns, loc="lower center", borderaxespad=0.3, labelcolor=INK
    )


# Picture of the error of windows over the number of samples since their start.


_COLUMNS = 2
_MANY_COLUMNS = 4
_FEW = 4
_NOTE_LINE = 0.125
GROWTH_MOST_PANELS = 16
_COLOURS: Final = (BLUE, ORANGE, GREEN, RED, QUIET, FAINT)
_MARK_COLOURS: Final = (QUIET, GREEN, RED, INK)
_MARKERS: Final = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True)
class ErrorCurve:
    """Error after each sample of the window, (H,)."""

    label: str
    values: Array


@dataclass(frozen=True)
class Marks:
    """Published errors: (horizon in samples, error)."""

    label: str
    points: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Growth:
    """Error growth of one output or group; `title` names it, `label` the axis."""

    title: str
    label: str
    lines: tuple[ErrorCurve, ...]
    marks: tuple[Marks, ...] = ()


def draw_growth(
    panels: Sequence[Growth], sampling_time: float, title: str, caption: str = ""
) -> Figure:
    """A panel each, the same lines and marks in all of them. sampling_time in seconds."""
    columns = _COLUMNS if len(panels) <= _FEW else _MANY_COLUMNS
    rows = -(-len(panels) // columns)
    width = picture_width() if columns == _COLUMNS else 1.3 * picture_width()
    each = 2.2 if columns == _COLUMNS else 1.55
    note = textwrap.wrap(caption, int(16 * width))
    below = _NOTE_LINE * len(note)
    figure = Figure(figsize=(width, 1.0 + rows * each + below), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[each] * rows + [below + 0.01])
    first: Axes | None = None
    last = max(len(line.values) for line in panels[0].lines)
    span = f"{sampling_time * 1000:g} ms" if sampling_time < 1 else f"{sampling_time:g} s"
    for index, panel in enumerate(panels):
        axes = figure.add_subplot(grid[index // columns, index % columns], sharex=first)
        first = first or axes
        _panel(axes, panel)
        axes.set_xlim(0, last * 1.04)
        if index + columns >= len(panels):
            axes.set_xlabel(
                f"Samples after the start, {span} each" if columns == _COLUMNS else "Samples"
            )
        else:
            axes.tick_params(labelbottom=False)
    if note:
        place = figure.add_subplot(grid[rows, :])
        place.set_axis_off()
        place.text(0.0, 1.0, "\n".join(note), va="top", fontsize=6.5, color=QUIET)
    if first is not None:
        figure_legend(figure, first.get_legend_handles_labels()[0], 3)
    entitle(figure, title)
    return figure


def _panel(axes: Axes, panel: Growth) -> None:
    for index, line in enumerate(panel.lines):
        at = np.arange(1, len(line.values) + 1)
        dashes = (4, 1.5) if index and panel.marks else (1, 0)
        axes.plot(
            at,
            line.values,
            color=_COLOURS[index % len(_COLOURS)],
            lw=1.6,
            dashes=dashes,
            label=plain(line.label, 44),
        )
    for index, marks in enumerate(panel.marks):
        axes.plot(
            [h for h, _ in marks.points],
            [v for _, v in marks.points],
            _MARKERS[index % len(_MARKERS)],
            mfc="white",
            mec=_MARK_COLOURS[index % len(_MARK_COLOURS)],
            mew=1.2,
            ms=5.0,
            label=plain(marks.label, 44),
        )
    axes.set_title(plain(panel.title, 30))
    axes.set_ylabel(plain(panel.label, 24))
    if panel.marks:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.set_ylim(bottom=0.0)
    quiet_grid(axes)


# The error over the horizon, from a run.


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
    return (problem.protocol.test.groups or single)[:GROWTH_MOST_PANELS]


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
    return shown((min(len(problem.outputs), GROWTH_MOST_PANELS), len(problem.outputs), "outputs"))


# Pictures of simulated outputs: held-out folds of the best experiment, and the opened test.


_MOST_SEGMENTS = 4


def draw_simulation(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Measured against simulated, a panel for each output and fold. When these are too many, the
    outputs and folds with the lowest fit index are shown, and the title says so."""
    score = experiment.score
    assert score is not None
    outputs = fold_outputs(run.store, experiment, folds)
    fits = [min(np.inf if f is None else f for f in fold.fit_index) for fold in score.folds]
    shown_folds = lowest(fits, MOST_PANELS // 2)
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
