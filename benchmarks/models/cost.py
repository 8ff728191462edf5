"""Constants of the families' expected fit seconds, from recorded searches.

asia run two_tanks_sim --agent random --experiments 40
python benchmarks/models/cost.py runs/two_tanks_sim-random-s0 ...

Reads the processor seconds of fits out of the ledgers of searches, and fits `start` and `unit` of
`asia.agents.library.family.Timing` for each family: least squares of the relative error, neither
below zero. Prints them and how far the expected seconds, as the cards have them now and as fitted,
lie from the measured ones: medians and 90 % quantiles of the ratio, either way.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from asia._timer import Activity
from asia.agents.library.family import Timing, work
from asia.agents.library.registry import family
from asia.ledger.artifacts import Store
from asia.ledger.run import open_run
from asia.problem.load import load_lock
from asia.recipe import read_recipe
from asia.search.agent_views import problem_facts

LEAST_SHARE = 0.1
FITTING = (Activity.TRACE, Activity.COMPILE, Activity.FIT)


@dataclass(frozen=True)
class Fit:
    """Work of a fit, and its seconds as measured and as expected now."""

    work: float
    seconds: float
    expected: float


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    found: dict[str, list[Fit]] = defaultdict(list)
    for run in parser.parse_args().runs:
        for name, fit in fits(run):
            found[name].append(fit)
    print("| family | fits | start | unit | ratio now | ratio fitted |")
    print("|---|---|---|---|---|---|")
    for name, own in sorted(found.items()):
        timing = fitted(own)
        now = ratios([f.expected for f in own], own)
        then = ratios([timing.start + timing.unit * f.work for f in own], own)
        print(f"| {name} | {len(own)} | {timing.start:.2f} | {timing.unit:.2g} | {now} | {then} |")


def fits(run: Path) -> list[tuple[str, Fit]]:
    """Fits of the library's recipes in one search."""
    opened = open_run(run)
    facts = problem_facts(load_lock(run / "problem.lock.toml"))
    store, found = Store(run / "artifacts"), list[tuple[str, Fit]]()
    for experiment in opened.view.finished:
        recipe = read_recipe(store.text(experiment.proposed.source))
        row = family(recipe.family) if recipe is not None else None
        if recipe is None or row is None or experiment.result is None:
            continue
        spent = sum(one.processor for one in experiment.result.spent if one.activity in FITTING)
        if spent and (folds := len(experiment.result.folds)):
            fit = Fit(work(facts, recipe), spent / folds, row.seconds(facts, recipe))
            found.append((row.name, fit))
    return found


def fitted(own: list[Fit]) -> Timing:
    """Least squares of the relative error; a tenth of the usual seconds at least grow with the
    work, because few fits show little of how they grow."""
    seconds, amount = (np.array([getattr(f, name) for f in own]) for name in ("seconds", "work"))
    least = LEAST_SHARE * float(np.median(seconds) / np.median(amount))
    rows = np.stack([np.ones(len(own)), amount], axis=1) / seconds[:, None]
    size = np.abs(rows).max(axis=0)
    start, more = nnls(rows / size, 1.0 - least * amount / seconds)[0] / size
    return Timing(float(start), least + float(more))


def ratios(expected: list[float], own: list[Fit]) -> str:
    """Median and 90 % quantile of the larger over the smaller."""
    ratio = np.array(expected) / np.array([f.seconds for f in own])
    either = np.maximum(ratio, 1 / ratio)
    return f"{np.median(either):.2f}, {np.quantile(either, 0.9):.2f}"


if __name__ == "__main__":
    main()
