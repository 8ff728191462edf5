"""Pictures of the evidence: residuals, validation checks, ablation, training records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from asia.data.trajectory import Array, Signal
from asia.judge.scoring.checks.check import Check, Verdict
from asia.judge.scoring.confirmation import Interval
from asia.judge.scoring.outcome import without_gaps
from asia.judge.scoring.residuals import Correlation, with_input, with_own_past
from asia.ledger.events import Ablated
from asia.ledger.run import Run
from asia.ledger.view import Experiment
from asia.problem.problem import Problem
from asia.problem.protocol import Fold
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
from asia.report.pictures.simulation import (
    MOST_PANELS,
    Heading,
    Panel,
    Piece,
    Words,
    draw_overlay,
)
from asia.report.simulated import (
    SimulatedCase,
    SimulatedCases,
    fold_outputs,
    lowest,
    telling,
    worst_fits,
)

# Picture of the ablation: contribution of each change with its interval.


Bar = tuple[str, Interval, str]


def draw_ablation(found: Ablated, run: str, v_name: str) -> Figure:
    """The gain over the baseline in its parts, and what each change of the lineage is worth, where
    these are known."""
    bars = [*_of_crossing(found), *_of_changes(found)]
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
    entitle(figure, f"{plain(run, 40)}: contributions to the gain of #{found.winner:02d}")
    return figure


def _of_crossing(found: Ablated) -> Sequence[Bar]:
    crossing = found.crossing
    if crossing is None:
        return ()
    return (
        ("gain over the baseline", crossing.gain, INK),
        ("its model alone", crossing.model, BLUE),
        ("its training alone", crossing.training, BLUE),
        ("interaction of both", crossing.interaction, BLUE),
    )


def _of_changes(found: Ablated) -> Sequence[Bar]:
    return [
        (f"the change of #{one.experiment:02d}", one.loss, QUIET)
        for one in found.left_out
        if one.loss is not None
    ]


# The validation dossier: a panel a check that has something to draw.


_COLOURS = (BLUE, ORANGE, GREEN, RED, QUIET)
_MOST_CURVES = 5
_COLUMNS = 3
# In inches.
_WIDTH = 11.0
_ROW = 2.5
_LEGEND_WIDTH = 3.2
_VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.DOUBT: ORANGE,
    Verdict.FAIL: RED,
    Verdict.SHOWN: QUIET,
    Verdict.ABSENT: QUIET,
}
_LOGARITHMIC = frozenset({"frequency response", "error spectrum"})
# Curves of so few points are marked at each.
_FEW_POINTS = 12
_MOST_LETTERS = 40


def draw_validation(checks: Sequence[Check], title: str) -> Figure:
    """Draw the checks of a validation; of many curves in one check the first ones."""
    drawn = [check for check in checks if check.curves]
    rows = [drawn[i : i + _COLUMNS] for i in range(0, len(drawn), _COLUMNS)]
    figure = Figure(figsize=(_WIDTH, _ROW), layout="constrained")
    height = 0.7 + _ROW * len(rows)
    for panels, row in zip(figure.subplots(len(rows), _COLUMNS, squeeze=False), rows, strict=True):
        height += max(_draw(axes, check) for axes, check in zip(panels, row, strict=False))
        for axes in panels[len(row) :]:
            axes.set_visible(False)
    figure.set_figheight(height)
    entitle(figure, plain(title, 200))
    return figure


def _draw(axes: Axes, check: Check) -> float:
    """Draw one check; return the height of its legend in inches."""
    shown = check.curves[:_MOST_CURVES]
    common = _common([curve.name for curve in shown])
    for colour, curve in zip(_COLOURS, shown, strict=False):
        if curve.band is not None:
            axes.axhspan(-curve.band, curve.band, color=SHADE, lw=0, zorder=0)
        name = plain(curve.name[len(common) :], _MOST_LETTERS)
        mark = "o" if len(curve.x) <= _FEW_POINTS else ""
        axes.plot(curve.x, curve.y, color=colour, lw=1.0, marker=mark, ms=3.0, label=name)
    if check.name in _LOGARITHMIC and any((curve.y > 0).any() for curve in shown):
        _logarithmic(axes)
    elif any(curve.band is not None for curve in check.curves):
        axes.axhline(0.0, color=INK, lw=0.7)
    elif all(len(curve.x) <= _FEW_POINTS for curve in shown):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_title(f"{check.name}: {check.verdict}", color=_VERDICTS[check.verdict])
    axes.set_xlabel(check.axes[0])
    axes.set_ylabel(check.axes[1])
    quiet_grid(axes)
    if len(shown) == 1:
        return 0.0
    title = plain(common.rstrip(" ,"), _MOST_LETTERS)
    return panel_legend(axes, _LEGEND_WIDTH, fontsize=6.5, title=title or None, title_fontsize=6.5)


def _common(names: Sequence[str]) -> str:
    """Return the text before the first comma if all names share it."""
    first = names[0].partition(", ")[0] + ", "
    return first if len(names) > 1 and all(name.startswith(first) for name in names) else ""


def _logarithmic(axes: Axes) -> None:
    """Both axes, with plain numbers."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(numticks=6))
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axis.set_minor_locator(NullLocator())


# Residual analysis of the best experiment on its held-out folds.


_MOST_ROWS = 4
_MOST_INPUTS = 3


def draw_residuals(
    run: Run, problem: Problem, experiment: Experiment, folds: Sequence[Fold]
) -> Figure:
    """Autocorrelation of the simulation residuals and their cross-correlation with each input,
    with 99 % bands; all held-out blocks together. Of many outputs those with the lowest fit."""
    outputs = fold_outputs(run.store, experiment, folds)
    blocks = [b for fold in folds for b in fold.validation]
    simulated = [y_hat for fold in outputs for y_hat in fold]
    residual = [
        without_gaps(b.y, y_hat) - y_hat for b, y_hat in zip(blocks, simulated, strict=True)
    ]
    inputs = [b.case.u for b in blocks]
    assert experiment.score is not None
    chosen = lowest(worst_fits(experiment.score), _MOST_ROWS)
    rows = len(chosen)
    columns = 1 + min(len(problem.inputs), _MOST_INPUTS)
    figure = Figure(
        figsize=(max(picture_width(), 2.9 * columns), 0.8 + 1.9 * rows), layout="constrained"
    )
    grid = figure.subplots(rows, columns, squeeze=False, sharex="col")
    for row, output in enumerate(chosen):
        e = [r[:, output] for r in residual]
        _whiteness(grid[row, 0], e, problem.outputs[output])
        for column in range(1, columns):
            u = [v[:, column - 1] for v in inputs]
            _independence(grid[row, column], e, u, problem.inputs[column - 1])
    for column, axes in enumerate(grid[-1]):
        axes.set_xlabel("Lag of the input [samples]" if column else "Lag [samples]")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    figure.align_ylabels(list(grid[:, 0]))
    title = f"Experiment {experiment.number}, {plain(experiment.proposed.title, 40)}: "
    title += f"residuals of the held-out folds, 99 % bands{_left_out(problem)}"
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
    _whiteness(row[0], e, None)
    for axes, u, signal in zip(row[1:], inputs, signals, strict=True):
        _independence(axes, e, u, signal)
    for place, axes in enumerate(row):
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        if last:
            axes.set_xlabel("Lag of the input [samples]" if place else "Lag [samples]")


def _left_out(problem: Problem) -> str:
    outputs, inputs = len(problem.outputs), len(problem.inputs)
    return shown(
        (min(outputs, _MOST_ROWS), outputs, "outputs with the lowest fit"),
        (min(inputs, _MOST_INPUTS), inputs, "inputs"),
    )


def _whiteness(axes: Axes, e: Sequence[Array], output: Signal | None) -> None:
    _stems(axes, with_own_past(e))
    axes.set_title("residual with its own past")
    name = "" if output is None else f"{plain(output.name, 20)}\n"
    axes.set_ylabel(f"{name}correlation [-]")


def _independence(axes: Axes, e: Sequence[Array], u: Sequence[Array], signal: Signal) -> None:
    _stems(axes, with_input(e, u))
    axes.set_title(f"residual with {plain(signal.name, 17)}")


def _stems(axes: Axes, found: Correlation) -> None:
    lags, y, band = found.lags, found.values, found.band
    axes.axhspan(-band, band, color=SHADE, lw=0, zorder=0)
    axes.axhline(0.0, color=INK, lw=0.7)
    axes.vlines(lags, 0.0, y, color=BLUE, lw=1.2)
    axes.plot(lags, y, "o", color=BLUE, ms=2.6)
    # A signal that never moves has no correlation and no band.
    shown = np.concatenate([y, [-band, band]])
    shown = shown[np.isfinite(shown)] if np.isfinite(shown).any() else np.zeros(1)
    low, high = float(shown.min()), float(shown.max())
    margin = 0.08 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    quiet_grid(axes)


# Pictures of a model on the records that it was fitted to: its simulation and its residuals.


_MOST_SEGMENTS = 4
_TRIED_MOST_INPUTS = 2
_BINS = 10
_FEWEST = 5
_MOST_DOTS = 3000
_TRIED_COLOURS = (BLUE, ORANGE, GREEN, RED)
_PART = {False: "training", True: "held out"}

Arrays = tuple[Array, Array, Array]


def draw_tried(shown_cases: SimulatedCases) -> Figure:
    """Measured against simulated and the residual below it, a panel for each fold and output. Of
    many outputs those with the largest residual."""
    parts = _parts(shown_cases)
    outputs = _worst(shown_cases, max(1, MOST_PANELS // len(parts)))
    panels = tuple(
        _panel(shown_cases, parts[key], key, output)
        for output in outputs
        for key in list(parts)[:MOST_PANELS]
    )
    title = headline_of(shown_cases) + shown(
        (len(outputs), len(shown_cases.outputs), "outputs, the largest residuals"),
        (min(len(parts), MOST_PANELS), len(parts), "parts"),
    )
    pieces = "windows" if shown_cases.windows else "records"
    return draw_overlay(panels, shown_cases.sampling_time, Words(title, "simulated", pieces=pieces))


def draw_tried_residuals(shown_cases: SimulatedCases) -> Figure:
    """Draw for each output the residual against the simulated output, and its correlation with its
    own past and with the inputs. All folds on the records that they train on; held-out cases if
    there are any.
    """
    outputs = _worst(shown_cases, _MOST_ROWS)
    inputs = range(min(len(shown_cases.inputs), _TRIED_MOST_INPUTS))
    columns = 2 + len(inputs)
    held_out = any(case.held_out for case in shown_cases.cases)
    figure = Figure(
        figsize=(1.33 * picture_width(), 0.8 + 2.1 * len(outputs)), layout="constrained"
    )
    grid = figure.subplots(len(outputs), columns, squeeze=False)
    arrays = [case.arrays() for case in shown_cases.cases if case.held_out == held_out]
    for row, output in enumerate(outputs):
        _curve(grid[row, 0], shown_cases, output)
        e = [y[:, output] - y_hat[:, output] for _, y, y_hat in arrays]
        u = [[given[:, i] for given, _, _ in arrays] for i in inputs]
        signals = [shown_cases.inputs[i] for i in inputs]
        row_axes: list[Axes] = list(grid[row, 1:])
        draw_correlations(row_axes, e, u, signals, last=output == outputs[-1])
    figure.align_ylabels(list(grid[:, 0]))
    part = "held-out part" if held_out else "training part"
    text = f"residuals of the {part}, bins with 2 standard errors, 99 % bands"
    entitle(figure, f"{shown_cases.title}: {text}")
    return figure


def headline_of(shown_cases: SimulatedCases) -> str:
    """The title, and why there is no panel of what a fold holds out."""
    if any(case.held_out for case in shown_cases.cases):
        return shown_cases.title
    return f"{shown_cases.title}: training part (the held-out part is not shown)"


def _parts(shown_cases: SimulatedCases) -> dict[tuple[int, bool], list[SimulatedCase]]:
    """The cases of each fold, training and held-out ones apart."""
    found: dict[tuple[int, bool], list[SimulatedCase]] = {}
    for case in shown_cases.cases:
        found.setdefault((case.fold, case.held_out), []).append(case)
    return found


def _worst(shown_cases: SimulatedCases, count: int) -> list[int]:
    """The outputs with the largest residual over their spread, in their own order."""
    arrays = [case.arrays() for case in shown_cases.cases]
    y = np.concatenate([measured for _, measured, _ in arrays])
    e = np.concatenate([measured - simulated for _, measured, simulated in arrays])
    spread = np.maximum(y.std(axis=0), 1e-300)
    order = np.argsort(-np.sqrt((e**2).mean(axis=0)) / spread, kind="stable")
    return sorted(int(k) for k in order[:count])


def _panel(
    shown_cases: SimulatedCases, cases: Sequence[SimulatedCase], key: tuple[int, bool], output: int
) -> Panel:
    fold, held_out = key
    signal = shown_cases.outputs[output]
    arrays = [case.arrays() for case in cases]
    e = np.concatenate([y[:, output] - y_hat[:, output] for _, y, y_hat in arrays])
    which = f", {plain(signal.name, 24)}" if len(shown_cases.outputs) > 1 else ""
    error = f"RMSE {quantity(float(np.sqrt((e**2).mean())), signal.unit)}, mean residual "
    return Panel(
        Heading(
            f"Fold {fold}, {_PART[held_out]}{which}", error + quantity(float(e.mean()), signal.unit)
        ),
        signal,
        tuple(_segments(shown_cases, cases, arrays, output)),
    )


def _segments(
    shown_cases: SimulatedCases,
    cases: Sequence[SimulatedCase],
    arrays: Sequence[Arrays],
    output: int,
) -> list[Piece]:
    if not shown_cases.windows:
        chosen = [(case.record, k) for k, case in enumerate(cases)][:_MOST_SEGMENTS]
    else:
        scale = np.maximum(np.concatenate([y for _, y, _ in arrays]).std(axis=0), 1e-300)
        found = telling([y for _, y, _ in arrays], [y_hat for _, _, y_hat in arrays], scale)
        step = shown_cases.sampling_time
        chosen = [(f"{word}: {cases[k].start * step:.3g} s", k) for word, k in found]
    return [
        Piece(name, cases[k].start, arrays[k][1][:, output], arrays[k][2][:, output])
        for name, k in chosen
    ]


def _curve(axes: Axes, shown_cases: SimulatedCases, output: int) -> None:
    """Residual against simulated output: faint samples, and the mean of each bin."""
    signal = shown_cases.outputs[output]
    axes.axhline(0.0, color=INK, lw=0.7)
    held_out = any(case.held_out for case in shown_cases.cases)
    for place, (key, cases) in enumerate(_parts(shown_cases).items()):
        if key[1] != held_out:
            continue
        colour = _TRIED_COLOURS[place % len(_TRIED_COLOURS)]
        arrays = [case.arrays() for case in cases]
        x = np.concatenate([y_hat[:, output] for _, _, y_hat in arrays])
        e = np.concatenate([y[:, output] for _, y, _ in arrays]) - x
        every = max(1, len(x) // _MOST_DOTS)
        axes.plot(x[::every], e[::every], ".", color=colour, ms=1.2, alpha=0.25, rasterized=True)
        _bin_means(axes, x, e, colour, f"fold {key[0]}")
    axes.set_title("residual along the output")
    axes.set_xlabel(f"simulated {axis_label(signal)}".replace("\n", " "))
    unit = plain(signal.unit, 8)
    axes.set_ylabel(f"{plain(signal.name, 20)}\nresidual" + (f" [{unit}]" if unit else ""))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    panel_legend(axes, 2.0, fontsize=7, handlelength=1.0)
    quiet_grid(axes)


def _bin_means(axes: Axes, x: Array, e: Array, colour: str, label: str) -> None:
    low, high = np.quantile(x, 0.01), np.quantile(x, 0.99)
    edges = np.linspace(float(low), float(high), _BINS + 1)
    place = np.clip(np.searchsorted(edges, x) - 1, 0, _BINS - 1)
    kept = [b for b in range(_BINS) if (place == b).sum() >= _FEWEST]
    centre = [float(x[place == b].mean()) for b in kept]
    mean = [float(e[place == b].mean()) for b in kept]
    error = [2.0 * float(e[place == b].std() / np.sqrt((place == b).sum())) for b in kept]
    axes.errorbar(
        centre, mean, error, color=colour, lw=1.3, marker="o", ms=3.0, capsize=2.0, label=label
    )
