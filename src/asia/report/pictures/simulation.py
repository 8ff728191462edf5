"""Pictures of simulated outputs, of long records and of windows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.data.trajectory import Array, Signal, spread_of
from asia.judge.scoring.euclidean_error import mee_table
from asia.judge.scoring.outcome import FoldRecord, fit_index
from asia.ledger.events import TestedModel, Unsealed
from asia.ledger.run import Run
from asia.ledger.simulated import (
    fold_outputs,
    lowest,
    opened_windows,
    representative_windows,
    worst_fits,
)
from asia.ledger.view import Experiment
from asia.problem.folds import Fold
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.problem.protocol import OutputGroup
from asia.report.drawing.places import Stretch, TimeAxis, last_sample, lay_out, time_unit
from asia.report.drawing.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    SERIES,
    SHADE,
    PlotWithStrip,
    arrange,
    axis_label,
    entitle,
    figure_legend,
    fill_band,
    headline,
    names_that_fit,
    number,
    picture_width,
    plain,
    plot_line,
    quantity,
    quiet_grid,
    shown,
)

# Measured against simulated outputs, the error in a strip below.


MOST_PANELS = 8
_SINGLE_COLUMN = 3
_DENSITY = 110
"""Columns an inch in which long curves are thinned."""
_BAND = 0.2


@dataclass(frozen=True)
class Segment:
    """One segment of a record.

    Attributes:
        start: index of its first sample in the record.
        measured, simulated: outputs (H,).
        others: further simulations (H,).
        skip: number of first samples that do not count.
        band: lower and upper edges (H,) of the output bands.
        below: values (H,) of a curve that stands in place of the errors.
    """

    name: str
    start: int
    measured: Array
    simulated: Array
    others: tuple[Array, ...] = ()
    skip: int = 0
    band: tuple[Array, Array] | None = None
    below: Array | None = None

    def cut(self, first: int, end: int) -> Self:
        """Return the samples from `first` to before `end`, counted from the start."""
        part = slice(first, end)
        return replace(
            self,
            start=self.start + first,
            measured=self.measured[part],
            simulated=self.simulated[part],
            others=tuple(one[part] for one in self.others),
            skip=max(0, min(self.skip, end) - first),
            band=None if self.band is None else (self.band[0][part], self.band[1][part]),
            below=None if self.below is None else self.below[part],
        )

    @property
    def errors(self) -> list[Array]:
        """Errors (H,) of the simulations."""
        return [self.measured - one for one in (self.simulated, *self.others)]


@dataclass(frozen=True)
class Panel:
    """One output over one or several segments.

    Attributes:
        error: its error in words.
        below: signal of the curves in place of the errors.
    """

    title: str
    error: str
    signal: Signal
    segments: tuple[Segment, ...]
    below: Signal | None = None

    def __len__(self) -> int:
        return sum(len(one.measured) for one in self.segments)

    def cut(self, first: int, last: int | None) -> Self:
        """Return the part between two samples, counted over all segments and clipped to them; at
        least two samples. last: None for the end."""
        begin = min(max(first, 0), len(self) - 2)
        end = max(len(self) if last is None else min(last + 1, len(self)), begin + 2)
        found: list[Segment] = []
        for one in self.segments:
            count = len(one.measured)
            if begin < count and end > 0:
                found.append(one.cut(max(begin, 0), min(end, count)))
            begin, end = begin - count, end - count
        return replace(self, segments=tuple(found))

    def error_limit(self) -> float:
        """Return the largest error that the strip shows: of several simulations, one that is far
        off does not hide the others."""
        each = zip(*(one.errors for one in self.segments), strict=True)
        sizes = sorted(
            max(float(np.nanmax(np.abs(e), initial=0.0)) for e in errors) for errors in each
        )
        return min(sizes[-1], 5 * sizes[0]) or sizes[-1] or 1.0


def draw_overlay(
    panels: Sequence[Panel],
    sampling_time: float,
    title: str,
    *,
    measured: str = "measured",
    simulated: str = "simulated",
    others: Sequence[str] = (),
    band: str = "",
    kind: str = "records",
    limit: float | None = None,
) -> Figure:
    """Draw a panel each, in two columns when there are many.

    Args:
        panels: the panels.
        sampling_time: in s.
        title: title of the picture.
        measured: name of what is to be reproduced.
        simulated: name of the simulation.
        others: names of further simulations.
        band: name of the output bands.
        kind: what the segments of a panel are.
        limit: largest error that a strip shows; default: all errors.
    """
    columns = 1 if len(panels) <= _SINGLE_COLUMN else 2
    characters, room = (80, 90) if columns == 1 else (56, 72)
    width = picture_width() if columns == 1 else 1.45 * picture_width()
    each = [[Stretch(s.start, len(s.measured)) for s in panel.segments] for panel in panels]
    unit = time_unit(sampling_time * max(last_sample(segments) for segments in each))
    figure = Figure()
    cells: list[PlotWithStrip] = []
    for index, (panel, segments) in enumerate(zip(panels, each, strict=True)):
        axis = lay_out(segments, sampling_time, unit, kind)
        plot = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        strip = figure.add_axes((0.0, 0.0, 1.0, 1.0), sharex=plot)
        _draw_panel(plot, strip, panel, axis, room, int(_DENSITY * width / columns))
        if limit is not None:
            strip.set_ylim(-limit, limit)
        heading = f"{panel.title}:  {panel.error}" if panel.error else panel.title
        if len(heading) > characters:
            heading = f"{panel.title}\n{panel.error}"
        plot.set_title(heading)
        plot.tick_params(axis="x", labelbottom=False, length=0)
        if index >= len(panels) - columns:
            strip.set_xlabel(axis.label)
        cells.append(PlotWithStrip(plot, strip, heading.count("\n") + 1 if heading else 0))

    every = [segment for panel in panels for segment in panel.segments]
    axes = figure.axes[0]
    handles: list[Artist] = [
        *axes.plot([], [], color=FAINT, lw=2.6, label=measured),
        *axes.plot([], [], color=BLUE, lw=1.1, label=simulated),
    ]
    for k, name in enumerate(others):
        handles += axes.plot([], [], lw=0.9, label=name, **_line_of_other(k))
    if any(s.band is not None for s in every):
        handles += axes.fill([np.nan], [np.nan], color=BLUE, alpha=_BAND, lw=0, label=band)
    if any(s.skip for s in every):
        handles += axes.fill([np.nan], [np.nan], color=SHADE, label="left out of the error")
    below = {"loc": "lower center", "borderaxespad": 0.3, "labelcolor": INK}
    figure_legend(figure, handles, 3 if len(handles) > 4 else 4, **below)
    arrange(figure, cells, columns, width, headline(title, width))
    return figure


def _line_of_other(index: int) -> dict[str, Any]:
    """Colour and dashes of the further simulations, from 0 on."""
    dashes = (4.0, 1.5) if index < len(SERIES) - 1 else (1.5, 1.5)
    return {"color": SERIES[1 + index % (len(SERIES) - 1)], "dashes": dashes}


def _draw_panel(
    plot: Axes, strip: Axes, panel: Panel, axis: TimeAxis, room: int, columns: int
) -> None:
    """Draw the curves and, in the strip, their errors.

    Args:
        room: characters for the names of segments.
        columns: those in which long curves are thinned, over all segments.
    """
    shade: dict[str, Any] = {"color": BLUE, "alpha": _BAND, "lw": 0, "gid": "band"}
    pairs = list(zip(panel.segments, axis.times, strict=True))
    strip.axhline(0.0, color=QUIET, lw=0.7)
    plot.patch.set_gid("plot")
    for segment, time in pairs:
        y, y_hat = segment.measured, segment.simulated
        many = max(1, columns * len(y) // len(panel))
        if segment.band is not None:
            fill_band(plot, time, segment.band, many, **shade)
        plot_line(plot, time, y, many, color=FAINT, lw=2.6, gid="measured")
        for k, other in enumerate(segment.others):
            line = _line_of_other(k)
            plot_line(plot, time, other, many, lw=0.9, gid="other", **line)
            if segment.below is None:
                plot_line(strip, time, y - other, many, lw=0.7, **line)
        plot_line(plot, time, y_hat, many, color=BLUE, lw=1.1, gid="simulated")
        if segment.below is not None:
            plot_line(strip, time, segment.below, many, color=ORANGE, lw=0.9)
            continue
        if segment.band is not None:
            low, high = (edge - y_hat for edge in segment.band)
            fill_band(strip, time, (low, high), many, **shade)
        plot_line(strip, time, y - y_hat, many, color=BLUE, lw=0.9)
    # A simulation that leaves the measured output far behind is cut off.
    y = np.concatenate([s.measured for s in panel.segments])
    if not np.isnan(y).all():
        least, most = float(np.nanmin(y)), float(np.nanmax(y))
        around = 0.6 * (most - least) or 1.0
        low, high = plot.get_ylim()
        plot.set_ylim(max(low, least - around), min(high, most + around))
    if any(s.others for s in panel.segments):
        strip.set_ylim(-panel.error_limit(), panel.error_limit())
    unit = plain(panel.signal.unit, 8)
    plot.set_ylabel(axis_label(panel.signal))
    if panel.below is not None:
        strip.set_ylabel(axis_label(panel.below), fontsize=7.5)
        strip.yaxis.set_major_locator(MaxNLocator(nbins=3))
    else:
        strip.set_ylabel(f"error\n[{unit}]" if unit else "error", fontsize=7.5)
        strip.yaxis.set_major_locator(MaxNLocator(nbins=3, symmetric=True))
    for axes in (plot, strip):
        quiet_grid(axes)
        axes.set_xlim(*axis.limits)
        for seam in axis.seams:
            axes.axvline(seam, color=QUIET, lw=0.8, dashes=(2, 2))
        for segment, time in pairs:
            if segment.skip > 0:
                end = time[min(segment.skip, len(time) - 1)]
                axes.axvspan(time[0], end, color=SHADE, lw=0, zorder=0)
    if len(pairs) > 1:
        low, high = plot.get_ylim()
        plot.set_ylim(low, high + 0.15 * (high - low))
        names = names_that_fit([s.name for s in panel.segments], axis.times, room)
        for name, time in zip(names, axis.times, strict=True):
            plot.annotate(
                name,
                xy=(float(time[0]), 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2.0, -1.0),
                textcoords="offset points",
                va="top",
                fontsize=7.0,
                color=QUIET,
            )


def draw_simulation(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Measured against simulated, see `simulation_panels`; the title says what is left out."""
    score = experiment.score
    assert score is not None
    panels, notes = simulation_panels(run, problem, experiment, folds)
    content = "held-out folds"
    if problem.protocol.kind == "windows":
        content = "best, median and worst held-out window of each fold"
    title = f"{_experiment(experiment)}: {content}, {run.view.v_name} = {number(score.value)}"
    names = overlay_names(problem)
    return draw_overlay(panels, problem.sampling_time, title + notes, **names)


def overlay_names(problem: Problem) -> dict[str, Any]:
    """The names of `draw_overlay` for held-out folds of a problem."""
    if problem.control is not None:
        return {"kind": "scenarios", "measured": "target", "simulated": "response"}
    return {"kind": "windows" if problem.protocol.kind == "windows" else "records"}


def simulation_panels(
    run: Run,
    problem: Problem,
    experiment: Experiment,
    folds: Sequence[Fold],
    others: Sequence[tuple[Run, Experiment]] = (),
) -> tuple[tuple[Panel, ...], str]:
    """Return held-out folds of an experiment with its simulations, a panel for each output and
    fold, and in words what is left out. When these are too many, the outputs and folds with the
    lowest fit index are shown. Of a controller the strip shows the input that moves most.

    Args:
        others: experiments with the same folds, whose simulations lie over these.
    """
    score = experiment.score
    assert score is not None
    outputs = [fold_outputs(r.store, e.folds, folds) for r, e in ((run, experiment), *others)]
    fits = [min(np.inf if f is None else f for f in fold.fit_index) for fold in score.folds]
    shown_folds = lowest(fits, MOST_PANELS // 2)
    control = problem.control
    count = len(problem.outputs) if control is None else len(control.controlled)
    channels = lowest(worst_fits(score)[:count], MOST_PANELS // len(shown_folds))
    panels = tuple(
        _fold_panel(problem, folds[k], score.folds[k], [one[k] for one in outputs], c)
        for c in channels
        for k in shown_folds
    )
    notes = shown(
        (len(shown_folds), len(folds), "folds"),
        (len(channels), count, "outputs"),
        why="shown, the lowest fit",
    )
    if problem.protocol.kind != "windows":
        notes += shown((min(len(problem.train), _MOST_SEGMENTS), len(problem.train), "records"))
    return panels, notes


_MOST_SEGMENTS = 4


def _experiment(experiment: Experiment) -> str:
    return f"Experiment {experiment.number}, {plain(experiment.proposed.title, 40)}"


def _fold_title(problem: Problem, fold: int, channel: int, score: FoldRecord) -> tuple[str, str]:
    signal, metric = problem.outputs[channel], find_metric(problem.protocol.metric)
    output = f", {plain(signal.name, 24)}" if len(problem.outputs) > 1 else ""
    error = quantity(score.per_channel(metric.name)[channel], metric.unit_of(signal.unit))
    fit = score.fit_index[channel]
    ending = "" if fit is None else f", fit {fit:.1f} %"
    return f"Fold {fold + 1}{output}", f"{plain(metric.label, 16)} {error}{ending}"


def _fold_panel(
    problem: Problem,
    fold: Fold,
    score: FoldRecord,
    outputs: Sequence[Sequence[Array]],
    channel: int,
) -> Panel:
    """The first records, or the windows with the least, the middle and the largest error over all
    outputs. outputs: simulated blocks of each experiment."""
    blocks = fold.held_out
    chosen = [(block.name, k) for k, block in enumerate(blocks[:_MOST_SEGMENTS])]
    if problem.protocol.kind == "windows":
        chosen = []
        measured = [block.y for block in blocks]
        for word, k in representative_windows(measured, outputs[0], fold.scale):
            record = f"record {blocks[k].record + 1}, " if len(problem.train) > 1 else ""
            start = blocks[k].start * problem.sampling_time
            chosen.append((f"{word}: {record}{start:.3g} s", k))
    control, inputs, moved = problem.control, list[Array](), 0
    if control is not None:
        start = np.array([a.start for a in control.actuators])
        ranges = np.array([a.max - a.min for a in control.actuators])
        inputs = [
            start + np.cumsum(outputs[0][k][:, len(control.controlled) :], axis=0)
            for _, k in chosen
        ]
        moved = int(np.argmax(np.ptp(np.concatenate(inputs), axis=0) / ranges))
    segments = tuple(
        Segment(
            name,
            blocks[k].start,
            blocks[k].y[:, channel],
            outputs[0][k][:, channel],
            tuple(one[k][:, channel] for one in outputs[1:]),
            below=inputs[place][:, moved] if inputs else None,
        )
        for place, (name, k) in enumerate(chosen)
    )
    title, error = _fold_title(problem, fold.index, channel, score)
    below = None if control is None else control.base.inputs[moved]
    return Panel(title, error, problem.outputs[channel], segments, below)


def draw_test(run: Run, problem: Problem, opened: Unsealed, ensemble: TestedModel) -> Figure:
    """Measured, ensemble and refitted model over the test, see `draw_tested`. A refitted model that
    failed is left out."""
    use = run.view.refitted.use if run.view.refitted else None
    title = f"Sealed test: experiment {opened.experiment}"
    title += f", model to use: {use}" if use else ""
    models = {f"ensemble of {problem.protocol.folds.count} fold models": ensemble}
    if isinstance(opened.refit, TestedModel):
        models["refitted on all training data"] = opened.refit
    return draw_tested(run, problem, opened, models, title)


def draw_tested(
    run: Run, problem: Problem, opened: Unsealed, models: Mapping[str, TestedModel], title: str
) -> Figure:
    """Draw measured and simulated outputs of the test: a panel for each trajectory and output,
    samples that do not count are shaded; or the best, median and worst window of the whole test, a
    panel for each output, of many those with the lowest fit index.

    Args:
        models: the models by their names, at least one.
        title: title of the picture, which says what is left out; "" for none.
    """
    shapes = [(length, len(opened.channels)) for length in opened.lengths]

    def read(artifact: str) -> tuple[Array, ...]:
        if opened.horizon is not None:
            return opened_windows(run, opened, artifact)
        return run.store.get_arrays(artifact, shapes)

    measured = read(opened.measured)
    simulated, *others = (read(model.y_hat) for model in models.values())
    bands, band = opened.bands, ""
    edges = None if bands is None else (read(bands.lower), read(bands.upper))
    if bands is not None:
        least = "" if len(bands.covered) == 1 else "at least "
        band = f"band of {bands.level:.0%}, holds {least}{min(bands.covered):.0%}"

    def segment(name: str, start: int, i: int, c: int, skip: int) -> Segment:
        return Segment(
            name,
            start,
            measured[i][:, c],
            simulated[i][:, c],
            tuple(other[i][:, c] for other in others),
            skip,
            (edges[0][i][:, c], edges[1][i][:, c]) if edges else None,
        )

    def panel(c: int, trajectory: str, segments: tuple[Segment, ...]) -> Panel:
        output = f", {plain(problem.outputs[c].name, 24)}" if len(opened.channels) > 1 else ""
        error = _test_error(problem, opened, c)
        return Panel(f"{trajectory or 'Test'}{output}", error, problem.outputs[c], segments)

    notes = ""
    if opened.horizon is None:
        channels = list(range(min(len(opened.channels), MOST_PANELS)))
        trajectories = range(min(len(shapes), max(1, MOST_PANELS // len(channels))))
        past, skip, names = problem.protocol.past, opened.skip, opened.trajectories
        panels = [
            panel(c, plain(names[i], 24), (segment(names[i], past, i, c, skip),))
            for c in channels
            for i in trajectories
        ]
        notes += shown(
            (len(channels), len(opened.channels), "outputs"),
            (len(trajectories), len(shapes), "trajectories"),
        )
    else:
        y = np.concatenate(measured)
        fits = fit_index(y, np.concatenate(simulated))
        channels = lowest([float(f) if np.isfinite(f) else np.inf for f in fits], MOST_PANELS)
        scale = spread_of(y)
        windows = list(representative_windows(measured, simulated, np.where(scale > 0, scale, 1.0)))
        panels = [
            panel(c, "", tuple(segment(f"{w}: window {i + 1}", 0, i, c, 0) for w, i in windows))
            for c in channels
        ]
        notes += f"; best, median and worst of {len(measured)} windows"
        notes += shown((len(channels), len(opened.channels), "outputs with the lowest fit"))
    names = list(models)
    return draw_overlay(
        panels,
        problem.sampling_time,
        title + notes,
        simulated=names[0],
        others=names[1:],
        band=band.replace("%", " %"),
        kind="records" if opened.horizon is None else "windows",
    )


def _test_error(problem: Problem, opened: Unsealed, channel: int) -> str:
    found = {"ensemble": opened.ensemble, "refit": opened.refit, "stack": opened.stack}
    models = {key: model for key, model in found.items() if isinstance(model, TestedModel)}
    several = f" ({len(opened.lengths)} trajectories)" if len(opened.lengths) > 1 else ""
    values = [
        f"{key} {number(model.scores[0].per_channel[channel])}" for key, model in models.items()
    ]
    metric = find_metric(next(iter(models.values())).scores[0].metric)
    unit = plain(metric.unit_of(problem.outputs[channel].unit), 12)
    return f"{plain(metric.label, 16)}{several} {', '.join(values)} {unit}".rstrip()


# The error of windows over the number of samples since their start.


_MOST_PANELS = 16
_COLOURS: Final = (BLUE, ORANGE, GREEN, RED, QUIET, FAINT)


def draw_horizon(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Mean error after each sample of the held-out windows, a panel for each output group (for
    each output where the problem names no groups) and a line for each fold; see `mee_table`."""
    simulations: dict[str, tuple[Sequence[Array], Sequence[Array]]] = {}
    outputs = fold_outputs(run.store, experiment.folds, folds)
    for fold, y_hat in zip(folds, outputs, strict=True):
        groups = problem.protocol.folds.groups
        held_out = f", {groups[fold.index].name}" if groups else ""
        name = f"fold {fold.index + 1}{held_out}: {len(fold.held_out)} windows"
        simulations[name] = [block.y for block in fold.held_out], y_hat
    title = f"{_experiment(experiment)}: error over the horizon, held-out folds"
    return _draw_errors(problem, simulations, title)


def draw_test_horizon(
    run: Run, problem: Problem, opened: Unsealed, ensemble: TestedModel
) -> Figure:
    """Mean error after each sample of the test windows, a panel for each output group: ensemble
    and refitted model."""
    models = {f"ensemble of {problem.protocol.folds.count} fold models": ensemble}
    if isinstance(opened.refit, TestedModel):
        models["refitted on all training data"] = opened.refit
    measured = opened_windows(run, opened, opened.measured)
    simulations = {
        name: (measured, opened_windows(run, opened, model.y_hat)) for name, model in models.items()
    }
    title = f"Sealed test: experiment {opened.experiment}, error over the horizon, "
    title += f"{len(measured)} windows"
    return _draw_errors(problem, simulations, title)


def _draw_errors(
    problem: Problem,
    simulations: Mapping[str, tuple[Sequence[Array], Sequence[Array]]],
    title: str,
) -> Figure:
    """simulations: measured and simulated windows (H, ny), by the name of their line."""
    names, groups = [s.name for s in problem.outputs], problem.protocol.test.groups
    if not groups:
        groups = tuple(OutputGroup(name, (name,)) for name in names)
        title += shown((min(len(names), _MOST_PANELS), len(names), "outputs"))
    groups = groups[:_MOST_PANELS]
    tables = {
        label: mee_table(measured, y_hat, names, groups, ())
        for label, (measured, y_hat) in simulations.items()
    }
    few = len(groups) <= 4
    columns, width, each = (2, 1.0, 2.2) if few else (4, 1.3, 1.55)
    rows = -(-len(groups) // columns)
    size = width * picture_width(), 1.0 + rows * each
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    seconds = problem.sampling_time
    span = f"{seconds * 1000:g} ms" if seconds < 1 else f"{seconds:g} s"
    first: Axes | None = None
    for place, group in enumerate(groups):
        axes = figure.add_subplot(grid[place // columns, place % columns], sharex=first)
        first = first or axes
        for index, (name, table) in enumerate(tables.items()):
            values = np.array(table.groups[place].steps)
            color, at = _COLOURS[index % len(_COLOURS)], np.arange(1, len(values) + 1)
            axes.plot(at, values, color=color, lw=1.6, label=plain(name, 44))
        units = {s.unit for s in problem.outputs if s.name in group.outputs}
        unit = f" [{units.pop()}]" if len(units) == 1 and units != {""} else ""
        kind = "Distance" if len(group.outputs) > 1 else "Error"
        if group.distance == "geodesic":
            kind = "Angle"
        axes.set_title(plain(group.name, 30))
        axes.set_ylabel(plain(f"{kind}{unit}", 24))
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(0, 1.04 * max(len(table.groups[place].steps) for table in tables.values()))
        quiet_grid(axes)
        if place + columns >= len(groups):
            axes.set_xlabel(f"Samples after the start, {span} each" if few else "Samples")
        else:
            axes.tick_params(labelbottom=False)
    if first is not None:
        figure_legend(figure, first.get_legend_handles_labels()[0], 3)
    entitle(figure, title)
    return figure
