"""Pictures of the evidence: residuals, validation checks, ablation, training records."""

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Signal
from asia.judge.scoring.checks.check import Check, CheckCurve, Verdict
from asia.judge.scoring.residuals import Correlation, with_input, with_own_past
from asia.ledger.events import Ablated
from asia.ledger.evidence import DrawnCheck
from asia.ledger.run import Run
from asia.ledger.simulated import (
    SimulatedCases,
    fold_outputs,
    lowest,
    representative_windows,
    worst_fits,
)
from asia.ledger.view import Experiment
from asia.problem.folds import Fold
from asia.problem.problem import Problem
from asia.report.drawing.places import LOGARITHMIC_CHECKS
from asia.report.drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    SHADE,
    axis_label,
    entitle,
    panel_legend,
    picture_width,
    plain,
    quantity,
    quiet_grid,
    shown,
)
from asia.report.pictures.simulation import MOST_PANELS, Panel, Segment, draw_overlay


def draw_ablation(found: Ablated, run: str, v_name: str) -> Figure:
    """The gain over the baseline in its parts, and what each change of the lineage is worth, where
    these are known, with intervals."""
    crossing = found.crossing
    bars = [] if crossing is None else [
        ("gain over the baseline", crossing.gain, INK),
        ("its model alone", crossing.model, BLUE),
        ("its training alone", crossing.training, BLUE),
        ("interaction of both", crossing.interaction, BLUE),
    ]  # fmt: skip
    bars += [
        (f"the change of #{one.experiment:02d}", one.loss, QUIET)
        for one in found.left_out
        if one.loss is not None
    ]
    figure = Figure(figsize=(picture_width(), 1.2 + 0.32 * max(1, len(bars))), layout="constrained")
    axes = figure.subplots()
    places = range(len(bars), 0, -1)
    for place, (_, interval, color) in zip(places, bars, strict=True):
        axes.barh(place, interval.value, height=0.62, color=color)
        if interval.high > interval.low:
            axes.plot([interval.low, interval.high], [place, place], color=INK, lw=1.2)
    axes.set_yticks(list(places), [name for name, _, _ in bars])
    axes.axvline(0.0, color=INK, lw=0.8)
    axes.set_ylim(0.3, len(bars) + 0.7)
    axes.set_xlabel(f"Decrease of {plain(v_name, 40)}")
    quiet_grid(axes)
    entitle(figure, f"{plain(run, 40)}: contributions to the gain of #{found.best:02d}")
    return figure


# The validation: a panel a check that has something to draw.


_COLOURS = (BLUE, ORANGE, GREEN, RED, QUIET)
_COLUMNS = 3
# In inches.
_ROW = 2.5
_LEGEND_WIDTH = 3.2
_VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.DOUBT: ORANGE,
    Verdict.FAIL: RED,
    Verdict.SHOWN: QUIET,
    Verdict.ABSENT: QUIET,
}


def draw_check(check: DrawnCheck) -> Figure:
    """Draw one check alone."""
    curves = [CheckCurve(c.name, np.array(c.x), np.array(c.y), c.band) for c in check.curves]
    figure = Figure(figsize=(picture_width(), _ROW), layout="constrained")
    axes = figure.subplots()
    height = _draw_curves(axes, check.name, check.axes, curves, picture_width() - 0.6)
    figure.set_figheight(_ROW + height)
    axes.set_title(plain(check.name))
    return figure


# Curves of so few points are marked at each.
_FEW_POINTS = 12
_MOST_LETTERS = 40


def draw_validation(checks: Sequence[Check], title: str) -> Figure:
    """Draw the checks of a validation; of many curves in one check the first ones."""
    drawn = [check for check in checks if check.curves]
    rows = [drawn[i : i + _COLUMNS] for i in range(0, len(drawn), _COLUMNS)]
    figure = Figure(figsize=(11.0, _ROW), layout="constrained")
    height = 0.7 + _ROW * len(rows)
    for panels, row in zip(figure.subplots(len(rows), _COLUMNS, squeeze=False), rows, strict=True):
        height += max(_draw_check(axes, check) for axes, check in zip(panels, row, strict=False))
        for axes in panels[len(row) :]:
            axes.set_visible(False)
    figure.set_figheight(height)
    entitle(figure, plain(title, 200))
    return figure


def _draw_check(axes: Axes, check: Check) -> float:
    """Draw one check with its verdict; return the height of its legend in inches."""
    height = _draw_curves(axes, check.name, check.axes, check.curves, _LEGEND_WIDTH)
    axes.set_title(f"{check.name}: {check.verdict}", color=_VERDICTS[check.verdict])
    return height


def _draw_curves(
    axes: Axes, check: str, labels: tuple[str, str], curves: Sequence[CheckCurve], width: float
) -> float:
    """Draw the curves of a check, of many the first ones; return the height of their legend, which
    is as wide as `width`, in inches."""
    banded = any(curve.band is not None for curve in curves)
    curves = curves[: len(_COLOURS)]
    # The text before the first comma is the title of the legend if all names share it.
    common = curves[0].name.partition(", ")[0] + ", " if curves else ""
    if len(curves) == 1 or not all(curve.name.startswith(common) for curve in curves):
        common = ""
    for colour, curve in zip(_COLOURS, curves, strict=False):
        if curve.band is not None:
            axes.axhspan(-curve.band, curve.band, color=SHADE, lw=0, zorder=0)
        name = plain(curve.name[len(common) :], _MOST_LETTERS)
        mark = "o" if len(curve.x) <= _FEW_POINTS else ""
        axes.plot(curve.x, curve.y, color=colour, lw=1.0, marker=mark, ms=3.0, label=name,
                  gid="curve")  # fmt: skip
    log_y = check in LOGARITHMIC_CHECKS and any((curve.y > 0).any() for curve in curves)
    log_x = log_y or (check == "phase" and any((curve.x > 0).any() for curve in curves))
    for is_log, scale, axis in (
        (log_x, axes.set_xscale, axes.xaxis),
        (log_y, axes.set_yscale, axes.yaxis),
    ):
        if is_log:
            scale("log")
            axis.set_major_locator(LogLocator(numticks=6))
            axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
            axis.set_minor_locator(NullLocator())
    if banded and not log_y:
        axes.axhline(0.0, color=INK, lw=0.7)
    elif not log_x and all(len(curve.x) <= _FEW_POINTS for curve in curves):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel(plain(labels[0]))
    axes.set_ylabel(fill(plain(labels[1], 80), 28))
    quiet_grid(axes)
    if len(curves) <= 1:
        return 0.0
    title = plain(common.rstrip(" ,"), _MOST_LETTERS)
    return panel_legend(axes, width, fontsize=6.5, title=title or None, title_fontsize=6.5)


# Residual analysis of the best experiment on its held-out folds.


_MOST_ROWS = 4
_MOST_INPUTS = 3


def draw_residuals(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Autocorrelation of the simulation residuals and their cross-correlation with each input,
    with 99 % bands; all held-out blocks together. Of many outputs those with the lowest fit."""
    assert experiment.score is not None
    outputs = fold_outputs(run.store, experiment.folds, folds)
    blocks = [b for fold in folds for b in fold.held_out]
    simulated = [y_hat for fold in outputs for y_hat in fold]
    residual = [b.simulated(one).residual for b, one in zip(blocks, simulated, strict=True)]
    chosen = lowest(worst_fits(experiment.score), _MOST_ROWS)
    inputs = problem.inputs[:_MOST_INPUTS]
    columns = 1 + len(inputs)
    size = max(picture_width(), 2.9 * columns), 0.8 + 1.9 * len(chosen)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(chosen), columns, squeeze=False, sharex="col")
    u = [[b.u[:, i] for b in blocks] for i in range(len(inputs))]
    for axes, output in zip(grid, chosen, strict=True):
        e = [r[:, output] for r in residual]
        draw_correlations(list(axes), e, u, inputs, last=output == chosen[-1])
        axes[0].set_ylabel(f"{plain(problem.outputs[output].name, 20)}\ncorrelation [-]")
    figure.align_ylabels(list(grid[:, 0]))
    title = f"Experiment {experiment.number}, {plain(experiment.proposed.title, 40)}: "
    title += "residuals of the held-out folds, 99 % bands"
    title += shown(
        (len(chosen), len(problem.outputs), "outputs with the lowest fit"),
        (len(inputs), len(problem.inputs), "inputs"),
    )
    entitle(figure, title)
    return figure


def draw_correlations(
    row: Sequence[Axes],
    e: Sequence[Array],
    inputs: Sequence[Sequence[Array]],
    signals: Sequence[Signal],
    *,
    last: bool,
) -> None:
    """Residuals e, one (H,) array a block, with their own past and with each input, on a row of
    axes; last: the row that names the lags."""
    _draw_correlation(row[0], with_own_past(e))
    row[0].set_title("residual with its own past")
    row[0].set_ylabel("correlation [-]")
    for axes, u, signal in zip(row[1:], inputs, signals, strict=True):
        _draw_correlation(axes, with_input(e, u))
        axes.set_title(f"residual with {plain(signal.name, 17)}")
    for place, axes in enumerate(row):
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        if last:
            axes.set_xlabel("Lag of the input [samples]" if place else "Lag [samples]")


def _draw_correlation(axes: Axes, found: Correlation) -> None:
    lags, y, band = found.lags, found.values, found.band
    axes.axhspan(-band, band, color=SHADE, lw=0, zorder=0)
    axes.axhline(0.0, color=INK, lw=0.7)
    axes.vlines(lags, 0.0, y, color=BLUE, lw=1.2)
    axes.plot(lags, y, "o", color=BLUE, ms=2.6)
    # A signal that never moves has no correlation and no band.
    known = np.concatenate([y, [-band, band]])
    known = known[np.isfinite(known)] if np.isfinite(known).any() else np.zeros(1)
    low, high = float(known.min()), float(known.max())
    margin = 0.08 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    quiet_grid(axes)


# A model on the records that it was fitted to: its simulation and its residuals.


_MOST_SEGMENTS = 4
_TRIED_MOST_INPUTS = 2
_BINS = 10
_FEWEST = 5
_MOST_DOTS = 3000


def draw_tried(tried: SimulatedCases) -> Figure:
    """Measured against simulated and the residual below it, a panel for each fold and output. Of
    many outputs those with the largest residual."""
    parts = _parts(tried)
    outputs = _worst(tried, max(1, MOST_PANELS // len(parts)))
    keys = list(parts)[:MOST_PANELS]
    panels = [_panel(tried, parts[key], key, output) for output in outputs for key in keys]
    title = tried.title
    if not any(out for _, out, _ in tried.cases):
        title += ": training part (the held-out part is not shown)"
    title += shown(
        (len(outputs), len(tried.outputs), "outputs, the largest residuals"),
        (len(keys), len(parts), "parts"),
    )
    kind = "windows" if tried.windows else "records"
    return draw_overlay(panels, tried.sampling_time, title, kind=kind)


def draw_tried_residuals(tried: SimulatedCases) -> Figure:
    """Draw for each output the residual against the simulated output, and its correlation with its
    own past and with the inputs. All folds on the records that they train on; held-out cases if
    there are any.
    """
    outputs = _worst(tried, _MOST_ROWS)
    inputs = tried.inputs[:_TRIED_MOST_INPUTS]
    held_out = any(out for _, out, _ in tried.cases)
    size = 1.33 * picture_width(), 0.8 + 2.1 * len(outputs)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(outputs), 2 + len(inputs), squeeze=False)
    cases = [case for _, out, case in tried.cases if out == held_out]
    u = [[case.u[:, i] for case in cases] for i in range(len(inputs))]
    for row, output in zip(grid, outputs, strict=True):
        _draw_residual(row[0], tried, output, held_out=held_out)
        e = [case.y[:, output] - case.y_hat[:, output] for case in cases]
        draw_correlations(list(row[1:]), e, u, inputs, last=output == outputs[-1])
    figure.align_ylabels(list(grid[:, 0]))
    part = "held-out part" if held_out else "training part"
    text = f"residuals of the {part}, bins with 2 standard errors, 99 % bands"
    entitle(figure, f"{tried.title}: {text}")
    return figure


def _parts(tried: SimulatedCases) -> dict[tuple[int, bool], list[SimulatedSegment]]:
    """The cases of each fold, training and held-out ones apart."""
    found: dict[tuple[int, bool], list[SimulatedSegment]] = {}
    for fold, held_out, case in tried.cases:
        found.setdefault((fold, held_out), []).append(case)
    return found


def _worst(tried: SimulatedCases, count: int) -> list[int]:
    """The outputs with the largest residual over their spread, in their own order."""
    y = np.concatenate([case.y for _, _, case in tried.cases])
    e = np.concatenate([case.y - case.y_hat for _, _, case in tried.cases])
    spread = np.maximum(y.std(axis=0), 1e-300)
    order = np.argsort(-np.sqrt((e**2).mean(axis=0)) / spread, kind="stable")
    return sorted(int(k) for k in order[:count])


def _panel(
    tried: SimulatedCases, cases: Sequence[SimulatedSegment], key: tuple[int, bool], output: int
) -> Panel:
    fold, held_out = key
    signal = tried.outputs[output]
    e = np.concatenate([case.y[:, output] - case.y_hat[:, output] for case in cases])
    chosen = [(case.name, k) for k, case in enumerate(cases)][:_MOST_SEGMENTS]
    if tried.windows:
        scale = np.maximum(np.concatenate([case.y for case in cases]).std(axis=0), 1e-300)
        found = representative_windows(
            [case.y for case in cases], [case.y_hat for case in cases], scale
        )
        step = tried.sampling_time
        chosen = [(f"{word}: {cases[k].start * step:.3g} s", k) for word, k in found]
    segments = [
        Segment(name, cases[k].start, cases[k].y[:, output], cases[k].y_hat[:, output])
        for name, k in chosen
    ]
    name = f", {plain(signal.name, 24)}" if len(tried.outputs) > 1 else ""
    rmse, mean = (
        quantity(float(value), signal.unit) for value in (np.sqrt((e**2).mean()), e.mean())
    )
    return Panel(
        f"Fold {fold}, {'held out' if held_out else 'training'}{name}",
        f"RMSE {rmse}, mean residual {mean}",
        signal,
        tuple(segments),
    )


def _draw_residual(axes: Axes, tried: SimulatedCases, output: int, *, held_out: bool) -> None:
    """Residual against simulated output: faint samples, and the mean of each bin with 2 standard
    errors."""
    signal, colours = tried.outputs[output], (BLUE, ORANGE, GREEN, RED)
    axes.axhline(0.0, color=INK, lw=0.7)
    for place, (key, cases) in enumerate(_parts(tried).items()):
        if key[1] != held_out:
            continue
        colour = colours[place % len(colours)]
        x = np.concatenate([case.y_hat[:, output] for case in cases])
        e = np.concatenate([case.y[:, output] for case in cases]) - x
        every = max(1, len(x) // _MOST_DOTS)
        axes.plot(x[::every], e[::every], ".", color=colour, ms=1.2, alpha=0.25, rasterized=True)
        low, high = float(np.quantile(x, 0.01)), float(np.quantile(x, 0.99))
        bins = np.searchsorted(np.linspace(low, high, _BINS + 1), x) - 1
        inside = [np.clip(bins, 0, _BINS - 1) == b for b in range(_BINS)]
        inside = [one for one in inside if one.sum() >= _FEWEST]
        centre = [float(x[one].mean()) for one in inside]
        mean = [float(e[one].mean()) for one in inside]
        error = [2.0 * float(e[one].std() / np.sqrt(one.sum())) for one in inside]
        axes.errorbar(
            centre,
            mean,
            error,
            color=colour,
            lw=1.3,
            marker="o",
            ms=3.0,
            capsize=2.0,
            label=f"fold {key[0]}",
        )
    axes.set_title("residual along the output")
    axes.set_xlabel(f"simulated {axis_label(signal)}".replace("\n", " "))
    unit = plain(signal.unit, 8)
    axes.set_ylabel(f"{plain(signal.name, 20)}\nresidual" + (f" [{unit}]" if unit else ""))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    panel_legend(axes, 2.0, fontsize=7, handlelength=1.0)
    quiet_grid(axes)
