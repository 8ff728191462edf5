"""Result of one check of a model."""

from dataclasses import dataclass
from enum import StrEnum

from asia.data.trajectory import Array

ALARM_RATE = 0.01
"""Probability of an alarm where nothing is wrong, for one check with all its tests."""


class Verdict(StrEnum):
    """Verdict of a check."""

    PASS = "pass"
    DOUBT = "doubt"
    FAIL = "fail"
    SHOWN = "shown"
    """Printed and drawn, not judged."""
    ABSENT = "none"
    """The check does not apply to this model or these records; the sentence gives the reason."""


class Cause(StrEnum):
    """Likely cause of a check that does not pass, in words."""

    DYNAMICS = "a delay or a state is missing"
    STATIC = "a saturation or another static nonlinearity is missing"
    FRICTION = "friction, play or hysteresis is missing"
    DRIFT = "a drift is missing"
    UNSTABLE = "a pole is unstable"
    SIGN = "a gain has the wrong sign"
    PARAMETERS = "the parameters of the system drift between the parts of the records"
    OVERFIT = "the model fits the noise of its training records"


@dataclass(frozen=True)
class CheckCurve:
    """One line to draw."""

    name: str
    x: Array
    """(n,)."""
    y: Array
    """(n,)."""
    band: float | None = None
    """Half the width of a band around zero that chance stays within; None without one."""


@dataclass(frozen=True)
class Check:
    """One check of a model."""

    name: str
    """A few words, unique within a validation report."""
    verdict: Verdict
    sentence: str
    """Finding, with numbers."""
    cause: Cause | None = None
    """Likely cause; None for a check that passes, and where none is known."""
    weight: float = 0.0
    """Weight among the checks that do not pass: the share of the residual that it explains, above 1
    for a model that must not be used."""
    curves: tuple[CheckCurve, ...] = ()
    axes: tuple[str, str] = ("", "")


@dataclass(frozen=True)
class RecordedCheck:
    """One check as a ledger holds it: without curves."""

    name: str
    """A few words, unique within a validation report."""
    verdict: Verdict
    sentence: str
    cause: str = ""
    """Probable cause; "" if none is named."""
    weight: float = 0.0
    """Importance among the checks that do not pass."""


def most_serious(checks: tuple[Check, ...]) -> Check | None:
    """The check to look at first; None where all pass."""
    raised = [c for c in checks if c.verdict in (Verdict.DOUBT, Verdict.FAIL)]
    return max(raised, key=lambda c: (c.weight, c.verdict is Verdict.FAIL), default=None)
