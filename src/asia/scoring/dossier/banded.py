"""Check of the coverage of the output bands."""

from __future__ import annotations

from collections.abc import Sequence

from asia.data import Array
from asia.scoring.dossier.check import Check, Verdict
from asia.scoring.dossier.records import percent

# How far the share may be below the level: on records of the same kind it hardly ever is.
_DOUBT, _FAIL = 0.1, 0.4
_MOST_NAMED = 3


def check_bands(held: Array, outputs: Sequence[str], level: float) -> Check:
    """held: of each output (ny,), the share of the measured samples within the bands."""
    each = sorted(zip(held.tolist(), outputs, strict=True))
    words = ", ".join(f"{name} {percent(share)}" for share, name in each[:_MOST_NAMED])
    rest = " at least" if len(each) > _MOST_NAMED else ""
    sentence = f"{percent(level)} output bands contained{rest}: {words}"
    short = level - each[0][0]
    verdict = Verdict.FAIL if short > _FAIL else Verdict.DOUBT if short > _DOUBT else Verdict.PASS
    return Check("output bands", verdict, sentence, weight=max(0.0, short))


def no_bands(reason: str) -> Check:
    """Return a check that does not apply, where a fold model does not simulate the record."""
    return Check("output bands", Verdict.ABSENT, f"does not apply: {reason}")
