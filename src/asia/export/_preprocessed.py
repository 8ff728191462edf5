"""`[preprocess]` composed into a model, so that exported files read and return measured signals.

The files step at the rate of the samples that were kept. Their state holds the inputs that a delay
still keeps back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asia.data import Array, Signal
from asia.data._preprocess import Preprocess
from asia.errors import UserError
from asia.export._composed import inlined
from asia.export._model import TrainingWindow
from asia.lowering import Builder, LoweredModel, Program


def kept_delays(done: Preprocess, inputs: Sequence[Signal]) -> list[int]:
    """Delay of each input, in samples that are kept.

    Raises:
        UserError: if one is no whole number.
    """
    every = done.decimate
    for signal in inputs:
        delay = done.delay.get(signal.name, 0)
        if delay % every:
            raise UserError(
                f"preprocess.delay of '{signal.name}' is {delay} samples, no multiple of decimate "
                f"{every}: exported files step at the rate of the samples that are kept; simulate "
                "with asia.simulate, or make a run with a multiple"
            )
    return [done.delay.get(s.name, 0) // every for s in inputs]


def measured(
    low: LoweredModel, done: Preprocess, inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> LoweredModel:
    """Convert a model of preprocessed signals to one of measured signals.

    Raises:
        UserError: as for `kept_delays`.
    """
    if not done:
        return low
    late = np.array(kept_delays(done, inputs))
    longest, nu = int(late.max()), low.nu
    initial = _begins(low, done, (inputs, outputs), late)
    held = [(longest, nu)] if longest else []
    step = Builder((*held, *low.states, (nu,)))
    u = len(step.inputs) - 1
    known = _stacked(step, 0, u) if longest else step.add("reshape", (u,), (1, nu))
    acting = _picked(step, known, (longest - late) * nu + np.arange(nu))
    states = range(len(held), len(held) + len(low.states))
    y, *after = inlined(step, low.step, [*states, _standard(step, acting, done, inputs)])
    offset, scale = (step.constant(a) for a in _numbers(done, outputs))
    y = step.add("add", (step.add("mul", (y, scale)), offset))
    line = [_picked(step, known, _rows(1, longest, nu))] if longest else []
    return LoweredModel(
        low.n_past_u + longest,
        low.n_past_y,
        nu,
        low.ny,
        low.single,
        initial,
        step.program([y, *line, *after]),
    )


def _begins(
    low: LoweredModel,
    done: Preprocess,
    signals: tuple[Sequence[Signal], Sequence[Signal]],
    late: NDArray[np.int64],
) -> Program:
    """Program for the states from the measured past window, before them the inputs that delays keep
    back."""
    longest, n, nu = int(late.max()), low.n_past_u, low.nu
    build = Builder(((n + longest, nu), (low.n_past_y, low.ny), (nu,)))
    known, channels = _stacked(build, 0, 2), np.arange(nu)
    rows = np.arange(n)[:, None] + longest - late
    past_u = _standard(build, _picked(build, known, rows * nu + channels), done, signals[0])
    past_y = _standard(build, 1, done, signals[1])
    first = _picked(build, known, (n + longest - late) * nu + channels)
    u = _standard(build, first, done, signals[0])
    line = [_picked(build, known, _rows(n, longest, nu))] if longest else []
    return build.program([*line, *inlined(build, low.initial, [past_u, past_y, u])])


def _rows(first: int, count: int, width: int) -> NDArray[np.int64]:
    return np.arange(first * width, (first + count) * width).reshape(count, width)


def measured_window(
    window: TrainingWindow,
    done: Preprocess,
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
) -> TrainingWindow:
    """Window in measured units, at the samples that are kept.

    It is shorter by the longest delay; inputs before it that no model reads are made up.
    """
    late = kept_delays(done, inputs)
    longest, n = max(late), len(window.past_u)
    acting = physical(np.concatenate([window.past_u, window.u]), done, inputs)
    rows = np.arange(len(acting))[:, None] - longest + np.array(late)
    u = acting[np.clip(rows, 0, len(acting) - 1), np.arange(acting.shape[1])]
    y_hat, y, past_y = (
        physical(side, done, outputs) for side in (window.y_hat, window.y, window.past_y)
    )
    samples = len(window.u) - longest
    return TrainingWindow(u[: n + longest], past_y, u[n + longest :], y_hat[:samples], y[:samples])


def physical(values: Array, done: Preprocess, signals: Sequence[Signal]) -> Array:
    """Convert preprocessed values (T, n) to the units they were measured in."""
    offset, scale = _numbers(done, signals)
    return values * scale + offset


def _numbers(done: Preprocess, signals: Sequence[Signal]) -> tuple[Array, Array]:
    offset = [done.offset.get(s.name, 0.0) for s in signals]
    scale = [done.scale.get(s.name, 1.0) for s in signals]
    return np.array(offset), np.array(scale)


def _standard(build: Builder, value: int, done: Preprocess, signals: Sequence[Signal]) -> int:
    """Compute (value - offset) / scale."""
    shape = build.shape(value)
    offset, scale = (build.constant(np.broadcast_to(a, shape)) for a in _numbers(done, signals))
    return build.add("div", (build.add("sub", (value, offset)), scale))


def _stacked(build: Builder, rows: int, last: int) -> int:
    """Append a row: rows (R, n) and (n,) -> (R + 1, n)."""
    (n,) = build.shape(last)
    return build.add("concat", (rows, build.add("reshape", (last,), (1, n))), (0,))


def _picked(build: Builder, value: int, places: NDArray[np.int64]) -> int:
    attrs = (places.ndim, *places.shape, *places.reshape(-1))
    return build.add("pick", (value,), tuple(int(a) for a in attrs))
