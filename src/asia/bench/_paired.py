"""Agents against each other, paired by seed."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from asia.bench._rows import FinishedSearch
from asia.bench._tables import TextTable
from asia.ledger import error_value

_NOTHING = "-"
_FEWEST = 6


def paired_table(runs: Sequence[FinishedSearch]) -> TextTable | None:
    """Return the paired comparison of each two agents; None for one agent.

    Columns: number of seeds with which the first is better, median ratio of V, and the exact
    two-sided p of Wilcoxon's signed-rank test on the logarithms.
    """
    names = list(dict.fromkeys(run.planned.arm.name for run in runs))
    best = {(run.planned.arm.name, run.planned.seed): _best(run) for run in runs}
    seeds = sorted({run.planned.seed for run in runs})
    rows: list[tuple[str, ...]] = []
    for first, second in itertools.combinations(names, 2):
        pairs = [(best.get((first, s)), best.get((second, s))) for s in seeds]
        both = [(a, b) for a, b in pairs if a is not None and b is not None]
        rows.append((f"{first} : {second}", *_cells(both)))
    if not rows:
        return None
    header = ("pair", "seeds", "first better", "median V ratio", "p")
    notes = [
        "V ratio: first over second, below 1 where the first is better. p: two-sided signed-rank "
        f"test over the seeds; with {len(seeds)} it cannot be below "
        f"{min(1.0, 2.0 ** (1 - len(seeds))):.2g}."
    ]
    if len(seeds) < _FEWEST:
        notes.append(f"With fewer than {_FEWEST} seeds no difference can be significant at 5 %.")
    return TextTable("Paired by seed", header, tuple(rows), tuple(notes))


def _cells(both: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    if not both:
        return ("0", _NOTHING, _NOTHING, _NOTHING)
    ratios = [a / b for a, b in both]
    better = sum(r < 1 for r in ratios)
    differ = any(r != 1 for r in ratios)
    p = _NOTHING
    if differ:
        test: Any = wilcoxon(np.log(ratios), method="exact")
        p = f"{float(test.pvalue):.2g}"
    return (str(len(both)), f"{better} of {len(both)}", error_value(statistics.median(ratios)), p)


def _best(run: FinishedSearch) -> float | None:
    best = run.view.best
    return best.score.value if best is not None and best.score is not None else None
