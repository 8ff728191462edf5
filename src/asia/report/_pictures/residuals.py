"""Residual analysis of the best experiment on its held-out folds."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.data import Array, Signal
from asia.ledger import Experiment, Run
from asia.problem.load import Problem
from asia.protocol import Fold
from asia.report._artifacts import fold_outputs
from asia.report._drawing.style import (
    BLUE,
    INK,
    SHADE,
    entitle,
    picture_width,
    plain,
    quiet_grid,
    shown,
)
from asia.report._pictures.simulation import lowest, worst_fits
from asia.scoring import Correlation, with_input, with_own_past, without_gaps

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
    low, high = min(-band, float(y.min())), max(band, float(y.max()))
    # A signal that never moves has no correlation and no band.
    margin = 0.08 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    quiet_grid(axes)
