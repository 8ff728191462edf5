"""Measured gains of moves, the table that `benchmarks/searches/gains.py` makes from ledgers."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection
from functools import cache
from importlib.resources import files

from asia.agents.library.move import plain_title
from asia.agents.library.trial_evidence import coloured, overfit
from asia.agents.view import Trial

PRIOR_TRIALS = 10.0
"""Trials that the weight on the card counts as; few measured ones change it little."""
# Fewer measured trials change no weight. Limits of the factor.
_FEWEST = 6
_LEAST, _MOST = 0.6, 1.5


def evidence_of(trial: Trial) -> str:
    """Class of the evidence on the trial that a move starts from, as in the table."""
    return "overfit" if overfit(trial) > 2.0 else "coloured" if coloured(trial) else "plain"


def name_of(title: str, names: Collection[str]) -> str:
    """Name of the move with this title; "" for the first trial of a family."""
    text = plain_title(title).partition(": ")[2]
    if text in names:
        return text
    patterns = ((n, re.escape(n).replace(r"\{state\}", ".+")) for n in names if "{state}" in n)
    return next((name for name, pattern in patterns if re.fullmatch(pattern, text)), "")


def measured_gain(move: str, trial: Trial) -> tuple[int, float]:
    """Return the number of recorded trials of a move on trials with such evidence, and the mean
    share of V that they gained."""
    return _table().get((move, evidence_of(trial)), (0, 0.0))


def gain_factor(move: str, trial: Trial) -> float:
    """Return the factor of a move's weight: its measured gain on trials with such evidence over the
    mean gain of all moves, shrunk towards 1 for few trials."""
    count, gain = measured_gain(move, trial)
    table = _table()
    total = sum(n for n, _ in table.values())
    mean = sum(n * g for n, g in table.values()) / total if total else 0.0
    if count < _FEWEST or mean <= 0:
        return 1.0
    factor = (PRIOR_TRIALS + count * gain / mean) / (PRIOR_TRIALS + count)
    return min(max(factor, _LEAST), _MOST)


@cache
def _table() -> dict[tuple[str, str], tuple[int, float]]:
    """Number of trials and mean gain by move and evidence."""
    text = files("asia.agents.library").joinpath("gains.csv").read_text("utf-8")
    rows = csv.DictReader(text.splitlines())
    return {(r["move"], r["evidence"]): (int(r["trials"]), float(r["gain"])) for r in rows}
