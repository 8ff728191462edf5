"""Missing outputs, delay, feedback, drift, converter steps and outliers of training records."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data._delay import FoundDelay, find_delay, find_feedback
from asia.data._trajectory import Array, Trajectory
from asia.problem._problem import Problem

# Shorter records hold too little for a correlation.
_SHORTEST = 64
# Samples times pairs of signals: with many pairs the beginning of the records has to do.
_WORK = 200_000
_TREND = 0.5
_STEP = 0.05
_SPIKE = 10.0
_NINES = re.compile(r"-?999+(\.9+)?")
# Shares between which usual values lie, and how many times their range others are away from them.
_USUAL, _FAR = (0.025, 0.975), 3.0


@dataclass(frozen=True)
class InputDelay:
    """Delay from an input to an output, by their names."""

    given: str
    output: str
    delay: FoundDelay


def input_delays(problem: Problem) -> tuple[InputDelay, ...]:
    """Every output with every input, where both move; none for short records."""
    if min(len(r) for r in problem.train) < _SHORTEST:
        return ()
    records = _first_samples(problem)
    return tuple(
        InputDelay(given.name, output.name, find_delay(records, i, j))
        for j, output in enumerate(problem.outputs)
        for i, given in enumerate(problem.inputs)
        if _moves(records, i, j)
    )


def delay_lines(problem: Problem, found: Sequence[InputDelay]) -> tuple[str, ...]:
    """Describe the delay from each input to each output, and the pairs where feedback was not
    tested."""
    lines: list[str] = []
    for output in problem.outputs:
        lags = [(a.given, a.delay.lag) for a in found if a.output == output.name]
        said = ", ".join(f"{n} {'not found' if lag is None else lag}" for n, lag in lags)
        if lags:
            lines.append(
                f"delay of output {output.name} in samples, the first correlation beyond its 99 % "
                f"band: {said}"
            )
    lines += [
        f"delay 0: output {a.output} responds to input {a.given} in the same sample. If the system "
        "cannot be so fast, a controller computes the input from that output"
        for a in found
        if a.delay.lag == 0
    ]
    if not found:
        return ()
    records = _first_samples(problem)
    blind = [
        given.name
        for i, given in enumerate(problem.inputs)
        if _moves(records, i, 0) and find_feedback(records, i, 0) is None
    ]
    if blind:
        lines.append(
            f"feedback: not tested for input {', '.join(blind)}, which no short filter whitens"
        )
    return tuple(lines)


def missing_lines(problem: Problem) -> list[str]:
    """Count the missing samples of each output."""
    measured = np.concatenate([r.measured for r in problem.train])
    found = [
        f"{output.name} {int(lost)} of {len(measured)}"
        for output, lost in zip(problem.outputs, (~measured).sum(axis=0), strict=True)
        if lost
    ]
    if not found:
        return ["missing values: none"]
    return [f"missing outputs, in samples, left out of fit and V: {', '.join(found)}"]


def data_doubts(problem: Problem) -> list[str]:
    """Sentences on feedback, and on drift, steps and outliers of the outputs."""
    doubts = _feedback(problem)
    for i, given in enumerate(problem.inputs):
        values = np.concatenate([r.u[:, i] for r in problem.train])
        doubts += _codes(values, f"input {given.name}", repeated=False)
    for j, output in enumerate(problem.outputs):
        name, unit = f"output {output.name}", f" {output.unit}".rstrip()
        parts = [r.y[:, j] for r in problem.train]
        if np.ptp(np.concatenate(parts)) == 0:
            continue
        doubts += _drift(problem.train, parts, name, unit)
        doubts += _steps(np.concatenate(parts), name, unit)
        doubts += _outliers(problem.train, parts, name)
        doubts += _codes(np.concatenate(parts), name, repeated=True)
    return doubts


def _first_samples(problem: Problem) -> list[Trajectory]:
    """Whole records up to a number of samples, at least the start of the first."""
    kept: list[Trajectory] = []
    left = max(_WORK // (len(problem.inputs) * len(problem.outputs)), _SHORTEST)
    for record in problem.train:
        if left < _SHORTEST:
            break
        kept.append(record[: min(len(record), left)])
        left -= len(record)
    return kept


def _moves(records: Sequence[Trajectory], channel: int, output: int) -> bool:
    return all(np.ptp(r.u[:, channel]) > 0 and np.ptp(r.y[:, output]) > 0 for r in records)


def _feedback(problem: Problem) -> list[str]:
    if min(len(r) for r in problem.train) < _SHORTEST:
        return []
    records = _first_samples(problem)
    return [
        f"input {given.name} follows earlier values of output {output.name}: it may come from a "
        "controller, and a model fitted in closed loop may describe the controller instead of "
        "the system"
        for i, given in enumerate(problem.inputs)
        for j, output in enumerate(problem.outputs)
        if _moves(records, i, j) and find_feedback(records, i, j)
    ]


def _drift(
    records: Sequence[Trajectory], parts: Sequence[Array], name: str, unit: str
) -> list[str]:
    """Describe a linear drift that explains most of the variance of the longest record."""
    k = int(np.argmax([len(p) for p in parts]))
    y = parts[k] - parts[k].mean()
    time = np.arange(len(y)) - (len(y) - 1) / 2
    total = float(y @ y)
    if len(y) < _SHORTEST or total == 0:
        return []
    slope = float(time @ y / (time @ time))
    if slope**2 * float(time @ time) <= _TREND * total:
        return []
    return [
        f"{name} {'rises' if slope > 0 else 'falls'} by {abs(slope) * (len(y) - 1):.3g}{unit} over "
        f"record '{records[k].name}', more than its other variation: the sensor may drift, or the "
        "record starts far from steady state"
    ]


def _steps(values: Array, name: str, unit: str) -> list[str]:
    """Describe a quantization step that is large relative to the signal."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * (levels[-1] - levels[0])]
    step, std = float(gaps.min()), float(values.std())
    if len(gaps) < 2 or step <= _STEP * std:
        return []
    multiples = (levels - levels[0]) / step
    if np.abs(multiples - np.round(multiples)).max() > 1e-3:
        return []
    floor = step / np.sqrt(12.0) / std
    return [
        f"{name} is quantized in steps of {step:.3g}{unit}: this alone causes an error of about "
        f"{floor:.1%} "
        "of its standard deviation"
    ]


def _outliers(records: Sequence[Trajectory], parts: Sequence[Array], name: str) -> list[str]:
    """Single samples that jump away from both neighbours, far beyond a usual change."""
    usual = float(np.median(np.abs(np.concatenate([np.diff(p) for p in parts]))))
    limit = max(_SPIKE * 1.4826 * usual, float(np.concatenate(parts).std()))
    if usual == 0:
        return []
    found: list[tuple[str, int]] = []
    for record, y in zip(records, parts, strict=True):
        if len(y) < 3:
            continue
        middle = np.median(np.stack([y[:-2], y[1:-1], y[2:]]), axis=0)
        hits = np.flatnonzero(np.abs(y[1:-1] - middle) > limit) + 2
        found += [(record.name, int(k)) for k in hits]
    if not found:
        return []
    many = "1 sample jumps" if len(found) == 1 else f"{len(found)} samples jump"
    where = f"sample {found[0][1]} of record '{found[0][0]}'"
    return [
        f"{name}: {many} away from both neighbours, the first at {where}: check for outliers, and "
        "cut the record there"
    ]


def _codes(values: Array, name: str, repeated: bool) -> list[str]:
    """Values far from all others that a logger writes where it has none: nines, such as -9999, and
    with `repeated` any that stay the same to the last digit."""
    low, high = (float(v) for v in np.quantile(values, _USUAL))
    away = _FAR * (high - low)
    far = (values < low - away) | (values > high + away)
    if away == 0 or not far.any():
        return []
    code = np.array([_NINES.fullmatch(f"{v:g}") is not None for v in values[far]])
    if repeated:
        same = np.diff(values) == 0
        code |= (np.append(same, False) | np.append(False, same))[far]
    found, others = values[far][code], values[~far]
    if not found.size:
        return []
    shown = ", ".join(f"{v:g}" for v in np.unique(found)[:3])
    return [
        f"{name} has {shown} in {len(found)} sample{'s' if len(found) > 1 else ''}, the others lie "
        f"from {others.min():.3g} to {others.max():.3g}: if these mark missing values, leave the "
        "cells empty"
    ]
