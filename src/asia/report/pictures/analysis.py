"""Figures of linear models."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asia.data.trajectory import Array, Signal
from asia.lowering.linear import (
    LinearModel,
    corner_frequencies,
    fold_band,
    settling_samples,
)
from asia.report.drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    figure_legend,
    label_decades,
    picture_width,
    plain,
    quiet_grid,
    shown,
)

_COLOURS = (BLUE, ORANGE, GREEN, RED, INK)
_MOST_PAIRS = 4


def draw_linear(
    points: Sequence[tuple[str, LinearModel, Sequence[LinearModel]]],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
) -> Figure:
    """A row for each pair of output and input (four at most): gain, phase and step response of
    every operating point, with 90 % bands by the fold models; poles and zeros, whole and those of
    the slow modes. For one pair a square of gain, step response, phase, poles and zeros."""
    pairs = [(i, j) for i in range(len(outputs)) for j in range(len(inputs))][:_MOST_PAIRS]
    rows, alone = len(pairs) + 1, len(pairs) == 1
    size = (1.35 * picture_width(), 0.6 + 2.3 * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, 2 if alone else 3, squeeze=False)
    panels = [(axes[0][0], axes[1][0], axes[0][1])] if alone else [tuple(row) for row in axes[:-1]]
    planes = [axes[1][1]] if alone else [axes[-1][0], axes[-1][1]]
    samples = max(settling_samples(model) for _, model, _ in points)
    low = min(float(corner_frequencies(model)[0]) for _, model, _ in points)
    for colour, (name, model, folds) in zip(_COLOURS, points, strict=False):
        high = 0.5 / model.sampling_time
        frequencies = np.geomspace(low, 0.98 * high, 300)
        response, steps = model.response(frequencies), model.step_response(samples)
        others = [one.response(frequencies) for one in folds]
        other_steps = [one.step_response(samples) for one in folds]
        t = model.sampling_time * np.arange(samples)
        for row, (i, j) in enumerate(pairs):
            gain, phase, step = panels[row]

            def curve(values: Any, i: int = i, j: int = j) -> Array:
                return values[:, i, j]

            def angle(values: Any) -> Array:
                return np.degrees(np.unwrap(np.angle(values)))

            gain.loglog(frequencies, np.abs(curve(response)), color=colour, label=plain(name))
            phase.semilogx(frequencies, angle(curve(response)), color=colour)
            step.step(t, curve(steps), color=colour, where="post")
            if len(others) > 1:

                def level(values: Any) -> Array:
                    return np.log(np.maximum(np.abs(curve(values)), 1e-300))

                sizes = fold_band(level(response), [level(one) for one in others])
                turns = fold_band(angle(curve(response)), [angle(curve(one)) for one in others])
                ways = fold_band(curve(steps), [curve(one) for one in other_steps])
                low_size, high_size = np.exp(np.clip(sizes, -690.0, 690.0))
                shade = {"color": colour, "alpha": 0.25, "lw": 0}
                gain.fill_between(frequencies, low_size, high_size, **shade)
                phase.fill_between(frequencies, *turns, **shade)
                step.fill_between(t, *ways, step="post", **shade)
        for plane in planes:
            for one, alpha in ((model, 1.0), *((fold, 0.3) for fold in folds)):
                _plot_poles(plane, one.poles, one.zeros, color=colour, alpha=alpha)
    for row, (i, j) in enumerate(pairs):
        gain, phase, step = panels[row]
        out, into = outputs[i], inputs[j]
        unit = f" [{out.unit or '1'}/{into.unit or '1'}]" if out.unit or into.unit else ""
        gain.set_title(plain(f"{out.name} by {into.name}: gain{unit}"))
        phase.set_title("phase [degrees]")
        step.set_title("response to a unit step")
        gain.set_xlabel("frequency [Hz]")
        phase.set_xlabel("frequency [Hz]")
        step.set_xlabel("time [s]")
        for axis in panels[row]:
            quiet_grid(axis)
            _limit_to_lines(axis)
        label_decades(gain.yaxis)
        for axis in (gain, phase):
            label_decades(axis.xaxis)
    for plane in planes:
        _draw_unit_circle(plane)
    planes[0].set_aspect("equal", adjustable="datalim")
    lines = panels[0][0].get_lines()
    if alone:
        figure_legend(figure, lines, 3)
        return figure
    slow = np.concatenate([model.poles for _, model, _ in points])
    slow = slow[np.abs(slow) > 0.5]
    reach = 1.3 * float(np.abs(slow - 1.0).max(initial=0.02))
    planes[1].set_xlim(1.0 - reach, 1.0 + 0.3 * reach)
    planes[1].set_ylim(-0.65 * reach, 0.65 * reach)
    planes[1].set_title("slow poles, beside 1")
    axes[-1][2].set_axis_off()
    left_out = shown((len(pairs), len(outputs) * len(inputs), "pairs")).strip(" ()")
    names = [str(one.get_label()) for one in lines]
    axes[-1][2].legend(lines, names, loc="center", frameon=False, title=left_out or None)
    return figure


def draw_poles(
    models: Sequence[tuple[str, NDArray[np.complex128], NDArray[np.complex128]]],
) -> Figure:
    """Draw poles and zeros of models in the z-plane. models: name, poles and zeros of each."""
    figure = Figure(figsize=(picture_width(), picture_width()), layout="constrained")
    plane = figure.subplots()
    for k, (name, poles, zeros) in enumerate(models):
        _plot_poles(plane, poles, zeros, color=_COLOURS[k % len(_COLOURS)], label=plain(name))
    _draw_unit_circle(plane)
    plane.set_aspect("equal", adjustable="datalim")
    figure_legend(figure, plane.get_legend_handles_labels()[0], 3)
    return figure


def _plot_poles(
    plane: Axes, poles: NDArray[np.complex128], zeros: NDArray[np.complex128], **settings: Any
) -> None:
    plane.plot(poles.real, poles.imag, "x", gid="poles", **settings)
    settings["label"] = None
    plane.plot(zeros.real, zeros.imag, "o", fillstyle="none", gid="zeros", **settings)


def _draw_unit_circle(plane: Axes) -> None:
    turn = np.linspace(0, 2 * np.pi, 800)
    plane.plot(np.cos(turn), np.sin(turn), color=QUIET, lw=0.7)
    plane.set_title("poles (x) and zeros (o)")
    quiet_grid(plane)


def _limit_to_lines(axis: Axes) -> None:
    """Show the lines whole, and of bands at most half as much again on each side."""
    y = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axis.get_lines()])
    logarithmic = axis.get_yscale() == "log"
    y = y[np.isfinite(y) & ((y > 0) if logarithmic else True)]
    if not y.size:
        return
    ends = np.array([y.min(), y.max()])
    ends = np.log(ends) if logarithmic else ends
    reach = 0.5 * max(float(ends[1] - ends[0]), 1e-6 * float(np.abs(ends).max()))
    ends = ends + np.array([-reach, reach])
    ends = np.exp(ends) if logarithmic else ends
    low, high = axis.get_ylim()
    axis.set_ylim(max(low, float(ends[0])), min(high, float(ends[1])))


def draw_frequency_response(
    frequency: Array,
    measured: NDArray[np.complex128],
    deviation: Array | None,
    models: Sequence[tuple[LinearModel, float]],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
) -> Figure:
    """A row for each pair of output and input (four at most): measured and modelled gain and phase,
    and the residual with the standard deviation of the measurement.

    Args:
        frequency: (F,) in Hz
        measured: (F, ny, nu)
        deviation: (F, ny, nu), where it is known
        models: models with their delays in s: the whole one, then those of the folds
    """
    pairs = [(i, j) for i in range(len(outputs)) for j in range(len(inputs))][:_MOST_PAIRS]
    figure = Figure(figsize=(1.35 * picture_width(), 1.0 + 2.3 * len(pairs)), layout="constrained")
    axes = figure.subplots(len(pairs), 3, squeeze=False)
    grid = np.unique(np.concatenate([np.geomspace(max(frequency[0], 1e-6 * frequency[-1]),
                                                  frequency[-1], 600), frequency]))  # fmt: skip

    def responses(at: Array) -> list[NDArray[np.complex128]]:
        return [model.response(at) * np.exp(-2j * np.pi * at * delay)[:, None, None]
                for model, delay in models]  # fmt: skip

    fine, same = responses(grid), responses(frequency)[0]
    for row, (i, j) in enumerate(pairs):
        gain, phase, rest = axes[row]
        gain.loglog(frequency, np.abs(measured[:, i, j]), ".", color=INK, ms=2.5, label="measured")
        angle = np.degrees(np.unwrap(np.angle(measured[:, i, j])))
        phase.semilogx(frequency, angle, ".", color=INK, ms=2.5)
        for k, one in enumerate(fine):
            curve = one[:, i, j]
            style = {"color": ORANGE, "lw": 1.0 if k == 0 else 0.6, "alpha": 1.0 if k == 0 else 0.4}
            label = ("model", "models of the folds")[min(k, 1)] if k < 2 else None
            gain.loglog(grid, np.abs(curve), label=label, **style)
            turned = np.degrees(np.unwrap(np.angle(curve)))
            # The same turn as the measured phase.
            turned += 360.0 * np.round(np.mean(np.interp(frequency, grid, -turned) + angle) / 360.0)
            phase.semilogx(grid, turned, **style)
        apart = np.abs(measured[:, i, j] - same[:, i, j])
        rest.loglog(frequency, apart, ".", color=BLUE, ms=2.5, label="residual")
        if deviation is not None:
            rest.loglog(frequency, deviation[:, i, j], color=QUIET, lw=0.9,
                        label="standard deviation of the measurement")  # fmt: skip
        gain.set_title(plain(f"{outputs[i].name} by {inputs[j].name}: gain"))
        phase.set_title("phase [degrees]")
        rest.set_title("residual")
        for axis in axes[row]:
            axis.set_xlabel("frequency [Hz]")
            label_decades(axis.xaxis)
            quiet_grid(axis)
        for axis in (gain, rest):
            label_decades(axis.yaxis)
    lines = [*axes[0][0].get_lines()[:3], *axes[0][2].get_lines()]
    figure_legend(figure, lines, 3)
    return figure
