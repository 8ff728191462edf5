"""Figures of the analysis commands: linear models, controlled loops, monitored records, proposed
experiments."""

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
    SHADE,
    axis_label,
    entitle,
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


def draw_control(
    responses: Sequence[tuple[str, Array, Array]],
    noisy: tuple[Array, Array] | None,
    sampling_time: float,
    setpoint: float,
    limits: tuple[float, float],
    names: tuple[str, str],
) -> Figure:
    """Output above, input below.

    Args:
        responses: name of the model, outputs (T,), inputs (T,); the first one is the model to use
        noisy: outputs and inputs of the first one with measurement noise
        names: labels of output and input
    """
    figure = Figure(figsize=(picture_width(), 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    t = sampling_time * np.arange(len(responses[0][1]))
    if noisy is not None:
        above.plot(t, noisy[0], color=QUIET, lw=0.7, label="with measurement noise")
        below.step(t, noisy[1], color=QUIET, lw=0.7, where="post")
    for number, (name, y, u) in reversed(list(enumerate(responses))):
        colour, width = _COLOURS[number % len(_COLOURS)], 1.8 if number == 0 else 1.0
        above.plot(t, y, color=colour, lw=width, label=plain(name))
        below.step(t, u, color=colour, lw=width, where="post")
    above.axhline(setpoint, color=INK, lw=0.8, ls="--")
    for limit in limits:
        if np.isfinite(limit):
            below.axhline(limit, color=INK, lw=0.8, ls=":")
    above.set_ylabel(plain(names[0]))
    below.set_ylabel(plain(names[1]))
    below.set_xlabel("time [s]")
    for axis in (above, below):
        quiet_grid(axis)
    figure_legend(figure, above.get_lines()[:-1], 4)
    return figure


# Points of a line in a picture of a monitored record.
_MOST = 4_000


def draw_monitor(
    t: Array,
    outputs: Sequence[tuple[Signal, Array, Array]],
    nis: tuple[Array, float, float],
    statistic: tuple[Array, float],
    parameters: Sequence[tuple[str, float, Array, Array]],
    alarms: Sequence[tuple[float, float]],
) -> Figure:
    """Panels over the time t (T,) in s, with the times without a valid model in red.

    Args:
        outputs: signal, measured (T,) and expected values (T,)
        nis: values (T,) and the ends of their 95 % band
        statistic: values (T,) of Page's test and the threshold
        parameters: name, value in the run, estimates (T,), half width (T,) of their 95 % band
        alarms: first and last times in s
    """
    rows = len(outputs) + 2 + len(parameters)
    figure = Figure(figsize=(picture_width(), 1.0 + 1.35 * rows), layout="constrained")
    axes: list[Any] = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    every = slice(None, None, max(len(t) // _MOST, 1))
    x = t[every]
    for axis, (signal, measured, expected) in zip(axes, outputs, strict=False):
        axis.plot(x, measured[every], color=INK, lw=0.8, label="measured")
        axis.plot(x, expected[every], color=ORANGE, lw=0.8, label="expected one sample ahead")
        axis.set_title(plain(signal.label))
    values, low, high = nis
    axis = axes[len(outputs)]
    axis.semilogy(x, np.maximum(values[every], 1e-3 * low + 1e-12), ".", color=BLUE, ms=1.5)
    axis.axhspan(low, high, color=QUIET, alpha=0.2, lw=0)
    axis.set_ylim(max(0.1 * low, 1e-4), max(10.0 * high, 2.0 * float(np.nanmax(values))))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_title("normalised innovation squared (NIS) and its 95 % band")
    sums, threshold = statistic
    axis = axes[len(outputs) + 1]
    axis.plot(x, sums[every], color=BLUE, lw=0.9)
    axis.axhline(threshold, color=RED, lw=0.9, ls="--")
    axis.set_title("Page's test: an alarm above the line")
    for axis, (name, nominal, estimate, wide) in zip(
        axes[len(outputs) + 2 :], parameters, strict=True
    ):
        axis.plot(x, estimate[every], color=GREEN, lw=1.0)
        axis.fill_between(
            x, (estimate - wide)[every], (estimate + wide)[every], color=GREEN, alpha=0.25, lw=0
        )
        axis.axhline(nominal, color=QUIET, lw=0.8, ls=":")
        axis.set_title(f"{plain(name)}: estimate with 95 % band, and value in the run (dotted)")
    for axis in axes:
        for first, last in alarms:
            axis.axvspan(first, last, color=RED, alpha=0.12, lw=0)
        quiet_grid(axis)
    axes[-1].set_xlabel("time [s]")
    figure_legend(figure, axes[0].get_lines()[:2], 2)
    return figure


def draw_experiment(
    columns: Sequence[tuple[str, Array, Array, Array, Array]],
    signals: tuple[Sequence[Signal], Sequence[Signal]],
    sampling_time: float,
    limits: tuple[Array, Array],
    keep: Array,
) -> Figure:
    """Inputs above, expected outputs below, a column a record.

    Args:
        columns: title, inputs (H, nu), simulations (M, H, ny), least and largest expected output
            (H, ny) of each record; the proposed one first
        signals: inputs and outputs
        limits: least and largest input, (nu,) each
        keep: least and largest permitted output, (2, ny)
    """
    inputs, outputs = signals
    rows = len(inputs) + len(outputs)
    figure = Figure(figsize=(picture_width(), 0.8 + 1.5 * rows), layout="constrained")
    axes = figure.subplots(rows, len(columns), sharex=True, sharey="row", squeeze=False)
    t = sampling_time * np.arange(len(columns[0][1]))
    for c, (title, u, y, lower, upper) in enumerate(columns):
        axes[0, c].set_title(title)
        for j, signal in enumerate(inputs):
            axis = axes[j, c]
            axis.step(t, u[:, j], color=_COLOURS[c % len(_COLOURS)], lw=1.0, where="post")
            for limit in (limits[0][j], limits[1][j]):
                axis.axhline(limit, color=INK, lw=0.8, ls=":")
            if c == 0:
                axis.set_ylabel(axis_label(signal))
        for i, signal in enumerate(outputs):
            axis = axes[len(inputs) + i, c]
            axis.fill_between(
                t, lower[:, i], upper[:, i], color=SHADE, lw=0, label="expected range"
            )
            for one in y[1:]:
                axis.plot(t, one[:, i], color=_COLOURS[c % len(_COLOURS)], lw=0.5, alpha=0.5)
            axis.plot(t, y[0][:, i], color=INK, lw=0.9, label="models")
            for limit in keep[:, i]:
                if np.isfinite(limit):
                    axis.axhline(limit, color=INK, lw=1.0, ls="--", label="limit of the output")
            if c == 0:
                axis.set_ylabel(axis_label(signal))
        axes[-1, c].set_xlabel("Time [s]")
    for axis in axes.reshape(-1):
        quiet_grid(axis)
    entitle(figure, "Proposed experiment, and records of equal energy")
    # Of the two limits of an output one is named.
    named = dict(zip(*reversed(axes[-1, 0].get_legend_handles_labels()), strict=True))
    figure_legend(figure, list(named.values()), 3)
    return figure
