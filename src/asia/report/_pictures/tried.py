"""Pictures of a model on the records that it was fitted to: its simulation and its residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from asia.data import Array
from asia.report._drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    RED,
    axis_label,
    entitle,
    panel_legend,
    picture_width,
    plain,
    quantity,
    quiet_grid,
    shown,
)
from asia.report._pictures.overlay import MOST_PANELS, Heading, Panel, Piece, Words, draw_overlay
from asia.report._pictures.residuals import draw_correlations
from asia.report._pictures.windows import telling
from asia.report._simulated import SimulatedCase, SimulatedCases

_MOST_SEGMENTS = 4
_MOST_ROWS = 4
_MOST_INPUTS = 2
_BINS = 10
_FEWEST = 5
_MOST_DOTS = 3000
_COLOURS = (BLUE, ORANGE, GREEN, RED)
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
    inputs = range(min(len(shown_cases.inputs), _MOST_INPUTS))
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
        colour = _COLOURS[place % len(_COLOURS)]
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
