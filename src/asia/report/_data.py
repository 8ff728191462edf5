"""What `asia check` draws: the training records and what the protocol makes of them."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from asia.problem import Array, Trajectory
from asia.problem.load import Problem
from asia.protocol import Fold, make_folds
from asia.report._style import (
    BLUE,
    INK,
    ORANGE,
    QUIET,
    SHADE,
    WIDTH,
    axis_label,
    headline,
    plain,
    quiet_grid,
    shown,
)
from asia.report._time import Stretch, TimeAxis, last_sample, lay_out, time_unit

_MOST_CHANNELS = 6
_MOST_RECORDS = 6
_MANY_SAMPLES = 20_000


def draw_data(problem: Problem) -> Figure:
    """Inputs and outputs of the training records over time; held-out blocks tinted by turns and
    past windows marked. Raises UserError when the records do not make folds."""
    folds = make_folds(problem.train, problem.protocol)
    records = problem.train[:_MOST_RECORDS]
    stretches = [Stretch(0, len(r)) for r in records]
    unit = time_unit(problem.sampling_time * last_sample(stretches))
    axis = lay_out(stretches, problem.sampling_time, unit)
    inputs, outputs = problem.inputs[:_MOST_CHANNELS], problem.outputs[:_MOST_CHANNELS]
    count = len(inputs) + len(outputs)
    figure = Figure(figsize=(WIDTH, 0.9 + 1.25 * count), layout="constrained")
    FigureCanvasAgg(figure)
    rows: list[Axes] = list(figure.subplots(count, 1, squeeze=False, sharex=True)[:, 0])
    for c, signal in enumerate(inputs):
        _channel(rows[c], [r.u[:, c] for r in records], axis, held=True)
        rows[c].set_ylabel(axis_label(signal))
    for c, signal in enumerate(outputs):
        _channel(rows[len(inputs) + c], [r.y[:, c] for r in records], axis, held=False)
        rows[len(inputs) + c].set_ylabel(axis_label(signal))
    for axes in rows:
        _folds(axes, folds, axis, problem)
    _names(rows[0], folds, records, axis)
    rows[-1].set_xlabel(axis.label)
    rows[-1].set_xlim(*axis.limits)
    figure.align_ylabels(rows)
    title = headline(_title(problem, len(inputs), len(outputs)), WIDTH)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    _legend(figure, rows[0], problem)
    return figure


def _channel(axes: Axes, values: Sequence[Array], axis: TimeAxis, held: bool) -> None:
    raster = sum(len(v) for v in values) > _MANY_SAMPLES
    for y, time in zip(values, axis.times, strict=True):
        style = "steps-post" if held else "default"
        axes.plot(time, y, color=INK if held else BLUE, lw=1.0, ds=style, rasterized=raster)
    quiet_grid(axes)


def _folds(axes: Axes, folds: Sequence[Fold], axis: TimeAxis, problem: Problem) -> None:
    past = problem.protocol.past
    for fold in folds:
        for block in fold.validation:
            if block.record >= len(axis.times):
                continue
            time = axis.times[block.record]
            start, last = time[block.start], time[min(block.stop, len(time) - 1)]
            if fold.index % 2 == 0:
                axes.axvspan(start, last, color=SHADE, lw=0, zorder=0)
            if past:
                before = time[block.start - past]
                axes.axvspan(before, start, color=ORANGE, alpha=0.55, lw=0, zorder=1)
    for seam in axis.seams:
        axes.axvline(seam, color=QUIET, lw=0.8, dashes=(2, 2))


def _names(
    axes: Axes, folds: Sequence[Fold], records: Sequence[Trajectory], axis: TimeAxis
) -> None:
    """Fold names over the first panel, or record names when there are several records."""
    spans: list[tuple[str, float]] = []
    if len(records) > 1:
        room = 80 // len(records)
        spans = [
            (plain(r.name, max(room, 4)), float(t[0] + t[-1]) / 2)
            for r, t in zip(records, axis.times, strict=True)
        ]
    elif len(folds) <= 10:
        time = axis.times[0]
        spans = [
            (f"fold {f.index + 1}", float(time[b.start] + time[b.stop - 1]) / 2)
            for f in folds
            for b in f.validation
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


def _title(problem: Problem, inputs: int, outputs: int) -> str:
    samples = sum(len(r) for r in problem.train)
    many = len(problem.train)
    text = f"{plain(problem.name, 30)}: {samples} training samples"
    text += f" in {many} records" if many > 1 else ""
    return text + shown(
        (inputs, len(problem.inputs), "inputs"),
        (outputs, len(problem.outputs), "outputs"),
        (min(many, _MOST_RECORDS), many, "records"),
    )


def _odd(folds: int) -> str:
    """Names of the tinted folds."""
    names = [str(k) for k in range(1, folds + 1, 2)]
    text = ", ".join(names if len(names) <= 3 else [*names[:2], "…"])
    return f"fold {text}" if len(names) == 1 else f"folds {text}"


def _legend(figure: Figure, axes: Axes, problem: Problem) -> None:
    rule = problem.protocol
    handles = axes.plot([], [], color=INK, lw=1.0, label="input")
    handles += axes.plot([], [], color=BLUE, lw=1.0, label="output")
    handles += axes.plot([], [], color=SHADE, lw=7.0, label=_odd(rule.folds.count))
    if rule.past:
        label = f"past window, {rule.past} samples"
        handles += axes.plot([], [], color=ORANGE, alpha=0.55, lw=7.0, label=label)
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
