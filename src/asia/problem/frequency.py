"""Frequency responses of a problem's training records, for `asia check`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data import Trajectory
from asia.data.frequency.periods import find_period
from asia.data.frequency.response import FrequencyResponse, frequency_response
from asia.errors import UserError
from asia.problem._problem import Problem


def check_period(records: Sequence[Trajectory], period: int | None) -> None:
    """Raise UserError where a record holds less than two periods."""
    for record in records:
        if period is not None and len(record) < 2 * period:
            raise UserError(
                f"data.period = {period}: record '{record.name}' has {len(record)} samples, "
                "expected two periods or more: correct it, or leave it out"
            )


def responses(problem: Problem) -> tuple[FrequencyResponse | None, ...]:
    """Return the frequency response of each output.

    A declared or detected period is used where there is one. None for an output with too little
    data.
    """
    period = problem.period or find_period(problem.train)
    return tuple(frequency_response(problem.train, k, period) for k in range(len(problem.outputs)))


def response_lines(problem: Problem) -> tuple[str, ...]:
    """The same in words, for people."""
    found = responses(problem)
    first = next((one for one in found if one is not None and one.period is not None), None)
    lines: list[str] = []
    if first is not None:
        whence = "declared" if problem.period else "found"
        records = len(problem.train)
        lines.append(
            f"period ({whence}): {first.period} samples; {first.periods} periods used of each of "
            f"{records} record{'s' if records > 1 else ''}"
        )
    pairs = zip(problem.outputs, found, strict=True)
    lines += [f"output {s.name}: {_words(one)}" for s, one in pairs if one is not None]
    return tuple(lines)


def _words(found: FrequencyResponse) -> str:
    levels = found.levels
    if levels.noise is None:
        return (
            f"no period; noise and distortion together {_decibels(levels.both)} (squared coherence "
            f"{1.0 - levels.both**2:.3g}): a linear model has V of about {levels.both:.2g}, "
            "or less where the system is as slow as the records are long"
        )
    parts = [f"noise {_decibels(levels.noise)}"]
    if levels.odd is not None:
        parts.append(f"odd distortion {_decibels(levels.odd)}")
    if levels.even is not None:
        parts.append(f"even distortion {_decibels(levels.even)}")
    if len(parts) == 1 and levels.distortion is not None:
        parts.append(f"distortion {_decibels(levels.distortion)}")
    text = f"{', '.join(parts)}; V cannot go below {levels.noise:.2g}"
    if levels.distortion is None:
        return text
    return f"{text}, and that of a linear model not below {levels.both:.2g}"


def _decibels(level: float) -> str:
    return f"{20.0 * np.log10(level):.0f} dB" if level > 1e-10 else "none"
