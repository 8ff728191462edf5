"""Statements about a plant: a value with its interval, or the reason why it is withheld."""

from __future__ import annotations

import math
from dataclasses import dataclass

LEAST_FIT = 80.0
"""Fit in percent from which the figures of a model are stated as properties of the plant."""
# Ratio of the ends of an interval of a positive quantity from which records do not determine it.
_WIDE = 10.0
NOT_IDENTIFIABLE = "not identifiable from these records"
UNSETTLED = "no interval: its ends by the folds or a missing effect are a factor of 10 apart"


@dataclass(frozen=True)
class Statement:
    """Value with its interval, or the reason why one of them is withheld."""

    value: float | None
    """None where it is withheld."""
    interval: tuple[float, float] | None = None
    unit: str = ""
    reason: str = ""
    """Why the value, or its interval, is withheld."""

    def __str__(self) -> str:
        if self.value is None:
            return f"none: {self.reason}"
        text = f"{self.value:.5g} {self.unit}".rstrip()
        if self.interval is not None:
            return f"{text} ({self.interval[0]:.4g} to {self.interval[1]:.4g})"
        return f"{text} ({self.reason})" if self.reason else text


def stated(
    value: float,
    interval: tuple[float, float] | None,
    unit: str = "",
    *,
    reason: str = "",
    at_bound: str = "",
    positive: bool = False,
) -> Statement:
    """State a value as far as its interval carries it.

    Args:
        interval: its ends; None where there is no estimate of them
        reason: why the value is withheld; "" where nothing is known against it
        at_bound: `lower` or `upper` for a value at this end of its range, which has no interval
        positive: whether the quantity is positive, so that only ratios count
    """
    if reason or not math.isfinite(value):
        return Statement(None, None, unit, reason or NOT_IDENTIFIABLE)
    if at_bound:
        return Statement(value, None, unit, f"at the {at_bound} end of its range")
    if interval is not None:
        low, high = interval
        open_ended = not (math.isfinite(low) and math.isfinite(high))
        if open_ended or (positive and value > 0 and high > _WIDE * max(low, 0.0)):
            return Statement(None, None, unit, NOT_IDENTIFIABLE)
    return Statement(value, interval, unit)


def fit_note(fit: float | None) -> str:
    """Sentence on a model that fits too little for statements about the plant; "" for others.

    Args:
        fit: 100 (1 - |error| / |output - mean|), in percent; None where it is not known
    """
    if fit is None or fit >= LEAST_FIT:
        return ""
    return (
        f"the model fits {max(fit, 0.0):.0f} %, below {LEAST_FIT:g} %: these figures are those of "
        "the model, not of the plant"
    )
