"""Pictures of a problem: records, delays, frequency response."""

from collections.abc import Mapping, Sequence
from itertools import groupby, zip_longest

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.data.frequency import FrequencyResponse
from asia.data.trajectory import Array
from asia.problem.check import InputDelay
from asia.problem.folds import Fold, make_folds
from asia.problem.problem import Problem
from asia.report.drawing.places import Stretch, TimeAxis, last_sample, lay_out, time_unit
from asia.report.drawing.style import (
    BLUE,
    INK,
    ORANGE,
    QUIET,
    SHADE,
    axis_label,
    entitle,
    figure_legend,
    names_that_fit,
    picture_width,
    plain,
    quiet_grid,
    shown,
)

_MOST_INPUTS = 6
_MOST_OUTPUTS = 12
_ONE_COLUMN = 8
_MOST_RECORDS = 6
_MANY_SAMPLES = 20_000
_SHADES = (SHADE, "#f7f0e0")
"""Tints of what odd and even folds hold out."""


def draw_data(problem: Problem) -> Figure:
    """Inputs and outputs of the training records over time, in two columns when there are many;
    what each fold holds out tinted by turns, and past windows marked where there is one a block.
    Raises UserError when the records do not make folds."""
    folds = make_folds(problem.train, problem.protocol)
    chosen = _records(problem)
    records = [problem.train[i] for i in chosen]
    segments = [Stretch(0, len(record)) for record in records]
    unit = time_unit(problem.sampling_time * last_sample(segments))
    axis = lay_out(segments, problem.sampling_time, unit)
    inputs, outputs = problem.inputs[:_MOST_INPUTS], problem.outputs[:_MOST_OUTPUTS]
    signals = [(s, True, c) for c, s in enumerate(inputs)]
    signals += [(s, False, c) for c, s in enumerate(outputs)]
    columns = 1 if len(signals) <= _ONE_COLUMN else 2
    width, rows = picture_width() * (1.0 if columns == 1 else 1.45), -(-len(signals) // columns)
    figure = Figure(figsize=(width, 0.9 + 1.25 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
    panels: list[Axes] = list(grid.T.ravel())
    raster = sum(map(len, records)) > _MANY_SAMPLES
    for axes, (signal, held, channel) in zip(panels, signals, strict=False):
        style, color = ("steps-post", INK) if held else ("default", BLUE)
        for record, time in zip(records, axis.times, strict=True):
            values = (record.u if held else record.measured_y)[:, channel]
            axes.plot(time, values, color=color, lw=1.0, ds=style, rasterized=raster)
        quiet_grid(axes)
        axes.set_ylabel(axis_label(signal))
        _tint_folds(axes, folds, dict(zip(chosen, axis.times, strict=True)), problem)
        for seam in axis.seams:
            axes.axvline(seam, color=QUIET, lw=0.8, dashes=(2, 2))
    for axes in panels[len(signals) :]:
        axes.set_axis_off()
    for column in range(columns):
        _names(grid[0, column], problem, folds, chosen, axis, 80 if columns == 1 else 56)
        last = grid[(len(signals) - column * rows if column else rows) - 1, column]
        last.set_xlabel(axis.label)
        last.tick_params(labelbottom=True)
        figure.align_ylabels(list(grid[:, column]))
    panels[0].set_xlim(*axis.limits)
    samples, many = sum(len(r) for r in problem.train), len(problem.train)
    title = f"{plain(problem.name, 30)}: {samples} training samples"
    title += f" in {many} records" if many > 1 else ""
    title += shown(
        (len(inputs), len(problem.inputs), "inputs"),
        (len(outputs), len(problem.outputs), "outputs"),
        (len(chosen), many, "records"),
    )
    entitle(figure, title)
    _legend(figure, panels[0], problem)
    return figure


def _records(problem: Problem) -> list[int]:
    """Numbers of the records to draw: the first of each group, then the second, while there is
    room; simply the first ones where there are no groups."""
    rule = problem.protocol.folds
    names = [r.name for r in problem.train]
    if not rule.groups or len(names) <= _MOST_RECORDS:
        return list(range(min(len(names), _MOST_RECORDS)))
    turns = zip_longest(*([names.index(n) for n in g.records] for g in rule.groups))
    ordered = [i for turn in turns for i in turn if i is not None]
    return sorted(ordered[:_MOST_RECORDS])


def _tint_folds(
    axes: Axes, folds: Sequence[Fold], times: Mapping[int, Array], problem: Problem
) -> None:
    past = problem.protocol.past if problem.protocol.kind == "simulation" else 0
    for fold in folds:
        for record, block in _spans(fold):
            if record in times:
                time = times[record]
                start, last = time[block.start], time[min(block.stop, len(time) - 1)]
                axes.axvspan(start, last, color=_SHADES[fold.index % 2], lw=0, zorder=0)
                if past:
                    before = time[block.start - past]
                    axes.axvspan(before, start, color=ORANGE, alpha=0.55, lw=0, zorder=1)


def _spans(fold: Fold) -> list[tuple[int, range]]:
    """Return record and samples of the held-out parts, with windows that touch as one part."""
    spans: list[tuple[int, range]] = []
    for block in fold.held_out:
        if spans and spans[-1][0] == block.record and spans[-1][1].stop >= block.start:
            start = spans.pop()[1].start
        else:
            start = block.start
        spans.append((block.record, range(start, block.stop)))
    return spans


def _names(
    axes: Axes,
    problem: Problem,
    folds: Sequence[Fold],
    chosen: Sequence[int],
    axis: TimeAxis,
    characters: int,
) -> None:
    """Fold names over the first panel, or names of records or of their groups when there are
    several records."""
    spans: list[tuple[str, float]] = []
    if len(chosen) > 1:
        groups = {n: g.name for g in problem.protocol.folds.groups for n in g.records}
        named = [groups.get(problem.train[i].name, problem.train[i].name) for i in chosen]
        groups_of = groupby(zip(named, axis.times, strict=True), key=lambda pair: pair[0])
        parts = [(name, np.concatenate([time for _, time in part])) for name, part in groups_of]
        names = names_that_fit([n for n, _ in parts], [time for _, time in parts], characters)
        middles = [float(time[0] + time[-1]) / 2 for _, time in parts]
        spans = list(zip(names, middles, strict=True))
    elif len(folds) <= 10:
        time = axis.times[0]
        spans = [
            (f"fold {f.index + 1}", float(time[b.start] + time[b.stop - 1]) / 2)
            for f in folds
            for _, b in _spans(f)
        ]
    for name, middle in spans:
        axes.annotate(
            name,
            xy=(middle, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0.0, 2.0),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=7.5,
            color=QUIET,
        )


def _legend(figure: Figure, axes: Axes, problem: Problem) -> None:
    rule = problem.protocol
    handles = axes.plot([], [], color=INK, lw=1.0, label="input")
    handles += axes.plot([], [], color=BLUE, lw=1.0, label="output")
    for first, shade in enumerate(_SHADES, 1):
        names = [str(k) for k in range(first, rule.folds.count + 1, 2)]
        text = ", ".join(names if len(names) <= 3 else [*names[:2], "…"])
        label = f"held out: fold{'' if len(names) == 1 else 's'} {text}"
        handles += axes.plot([], [], color=shade, lw=7.0, label=label)
    if rule.kind == "windows":
        handles += axes.plot([], [], alpha=0, label=f"windows of {rule.horizon} samples")
    elif rule.past:
        label = f"past window, {rule.past} samples"
        handles += axes.plot([], [], color=ORANGE, alpha=0.55, lw=7.0, label=label)
    figure_legend(figure, handles, 3)


# The correlation of each input with each output, by lag.


_MOST = 4
# Lags beyond the delay that are shown.
_AFTER = 20


def draw_delays(problem: Problem, found: Sequence[InputDelay]) -> Figure:
    """A panel for each output and input, of at most four of each; only the first lags."""
    outputs = list(dict.fromkeys(a.output for a in found))[:_MOST]
    inputs = list(dict.fromkeys(a.given for a in found))[:_MOST]
    figure = Figure(figsize=(picture_width(), 0.9 + 1.5 * len(outputs)), layout="constrained")
    grid = figure.subplots(len(outputs), len(inputs), squeeze=False, sharex=True)
    lags = 1 + _AFTER + max((a.delay.lag or 0) for a in found)
    for answer in found:
        if answer.output not in outputs or answer.given not in inputs:
            continue
        axes = grid[outputs.index(answer.output), inputs.index(answer.given)]
        values = answer.delay.correlation[:lags]
        axes.vlines(np.arange(len(values)), 0.0, values, color=BLUE, lw=1.5)
        axes.axhspan(-answer.delay.band, answer.delay.band, color=INK, alpha=0.15, lw=0.0)
        lag, ends = answer.delay.lag, answer.delay.interval
        if ends is not None:
            axes.hlines(0.0, *ends, color=ORANGE, lw=4.0, alpha=0.6)
        if lag is not None and lag < len(values):
            axes.plot([lag], [answer.delay.correlation[lag]], "o", ms=4.0, color=ORANGE)
        quiet_grid(axes)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes, name in zip(grid[:, 0], outputs, strict=True):
        axes.set_ylabel(plain(name, 14))
    for axes, name in zip(grid[0], inputs, strict=True):
        axes.set_title(plain(name, 20))
    figure.supxlabel(
        "lag [samples]; grey: what one of a hundred files exceeds by chance, over all panels;\n"
        "dot and line: the delay and its 95 % interval, by a process model of all lags together",
        fontsize="medium",
    )
    entitle(figure, f"{plain(problem.name, 30)}: correlation of inputs with outputs, whitened")
    return figure


# Levels by frequency: output, noise and the residual of a linear model.


_RESPONSE_MOST_OUTPUTS = 4
_DEEPEST = 1e-9


def draw_responses(problem: Problem, found: tuple[FrequencyResponse | None, ...]) -> Figure:
    """Draw one panel for each output; amplitudes in dB of the output's standard deviation."""
    shown = [
        (signal, one) for signal, one in zip(problem.outputs, found, strict=True) if one is not None
    ][:_RESPONSE_MOST_OUTPUTS]
    figure = Figure(figsize=(picture_width(), 0.9 + 2.2 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (signal, one) in zip(grid, shown, strict=True):
        size = float(np.sqrt((one.output**2).sum()))
        for values, color, label in (
            (one.output, BLUE, "output"),
            (one.rest, ORANGE, "left by the best linear model"),
            (one.noise, INK, "noise"),
        ):
            if np.isfinite(values).any():
                levels = 20.0 * np.log10(np.maximum(values / size, _DEEPEST))
                axes.plot(one.frequency, levels, ".", ms=2.0, color=color, label=label)
        axes.set_ylabel(f"{plain(signal.name, 20)} [dB]")
        quiet_grid(axes)
    grid[-1].set_xlabel("frequency [Hz]")
    grid[0].set_xscale("log")
    # Text is drawn as it is here, without formulas.
    grid[-1].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    period = shown[0][1].period
    how = f"period of {period} samples" if period is not None else "no period"
    entitle(figure, f"{plain(problem.name, 30)}: levels by frequency, {how}")
    figure_legend(figure, grid[0].get_legend_handles_labels()[0], 3, markerscale=4)
    return figure
