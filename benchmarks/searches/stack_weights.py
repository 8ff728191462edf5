"""Test errors of stack, model to use and winner by several rules for weights and for the winner.

python benchmarks/zoo.py --zoo DATA/zoo --runs runs-zoo
python benchmarks/searches/stack_weights.py runs-zoo/now

No search is started: the fold models that the runs keep simulate the first test record, and each
rule forms its stack from them; its nested V is taken to be that of the run's stack. Errors are
relative to those of the winner's ensemble. The second table has the ensembles of other winners:
the smallest model (bytes of the stored fold models) of those that count as equal to the least V.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import geometric_mean

import numpy as np

from asia.data import Array, Trajectory
from asia.ledger.events import Stack, StackMember
from asia.ledger.run import open_run
from asia.problem.folds import cut
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.search.final import FinalEvidence, choose_model, stack_weights
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import FinalMember, final_members, fold_models, simulate_members

Weights = Callable[[Array], Array]


def power(exponent: float, near: float) -> Weights:
    """Weights inverse to this power of V, for candidates within so many times the best V."""

    def weights(values: Array) -> Array:
        mean = values.mean(axis=0)
        found = np.where(mean <= near * mean.min(), (mean.min() / mean) ** exponent, 0.0)
        return found / found.sum()

    return weights


RULES: dict[str, Weights] = {
    "equal, 1.1 times": power(0.0, 1.1),
    "equal, 1.5 times": power(0.0, 1.5),
    "power 2, 1.5 times": power(2.0, 1.5),
    "power 8, 2 times": power(8.0, 2.0),
    "asia": stack_weights,
}


Equal = Callable[[Array, Array], bool]
"""Whether V of the folds (folds,) is as good as the least V of the folds (folds,)."""


def on_every_fold(values: Array, best: Array) -> bool:
    """Return whether the best one does not gain on every fold."""
    return bool((values <= best).any())


def within_deviations(most: float) -> Equal:
    """V within so many standard errors of the paired differences."""

    def equal(values: Array, best: Array) -> bool:
        apart = values - best
        return bool(apart.mean() <= most * apart.std(ddof=1) / len(apart) ** 0.5)

    return equal


WINNERS: dict[str, Equal] = {
    "least V": lambda values, best: bool((values == best).all()),
    "within 1 %": lambda values, best: bool(values.mean() <= 1.01 * best.mean()),
    "within 3 %": lambda values, best: bool(values.mean() <= 1.03 * best.mean()),
    "within 10 %": lambda values, best: bool(values.mean() <= 1.1 * best.mean()),
    "within half a standard error": within_deviations(0.5),
    "within a standard error": within_deviations(1.0),
    "no gain on every fold": on_every_fold,
    "the same, within 10 %": lambda values, best: bool(
        on_every_fold(values, best) and values.mean() <= 1.1 * best.mean()
    ),
}


def errors(folder: Path, problem: Path) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """Errors relative to the ensemble: of stack and model to use by rule for the weights, and of
    the winner's ensemble by rule for the winner."""
    run = open_run(folder)
    view, locked = run.view, load_lock(folder / LOCK)
    assert view.best is not None
    assert view.refitted is not None
    evaluator, rule = make_evaluator(locked, view), locked.protocol
    record = test_record(locked, problem)
    block = cut(record, rule.past, len(record), rule, 0)

    def simulated(members: Sequence[FinalMember]) -> Array:
        return simulate_members(evaluator, run, members, [block])[0].mean(axis=0)

    scored = [e for e in view.finished if e.score is not None and e.result is not None
              and e.result.duplicate_of is None]  # fmt: skip
    values = np.array([[fold.value for fold in e.score.folds] for e in scored if e.score]).T
    outputs = [simulated((fold_models(e),)) for e in scored]
    ensemble = outputs[[e.number for e in scored].index(view.best.number)]
    refit = simulated(final_members(view, "refit")) if view.refitted.model else ensemble

    def error(y: Array) -> float:
        return float(np.sqrt((((block.y - y) / block.y.std(axis=0)) ** 2).mean()))

    found: dict[str, tuple[float, float]] = {}
    for name, weights in RULES.items():
        shares = weights(values)
        stack = np.tensordot(shares, np.stack(outputs), 1)
        nested = view.refitted.stack
        made = None
        if np.count_nonzero(shares) > 1 and nested is not None:
            members = [StackMember(e.number, float(w)) for e, w in zip(scored, shares, strict=True)]
            made = Stack(tuple(members), nested.value, nested.folds)
        use = choose_model(replace(FinalEvidence.of(view.best, view.refitted), stack=made)).model
        named = {"stack": stack, "refit": refit, "ensemble": ensemble}[use]
        found[name] = error(stack) / error(ensemble), error(named) / error(ensemble)
    least = values[:, int(np.argmin(values.mean(axis=0)))]
    sizes = [len(run.store.get(fold.model)) for e in scored if e.result for fold in e.result.folds]
    sizes = np.reshape(sizes, (len(scored), -1)).sum(axis=1)
    winners: dict[str, float] = {}
    for name, equal in WINNERS.items():
        fit = [k for k in range(len(scored)) if equal(values[:, k], least)]
        best = min(fit, key=lambda k: (sizes[k], values[:, k].mean()))
        winners[name] = error(outputs[best]) / error(ensemble)
    return found, winners


def test_record(problem: Problem, folder: Path) -> Trajectory:
    """The record test.csv of a problem folder."""
    with (folder / "test.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    u, y = (
        np.array([[float(row[signal.name]) for signal in signals] for row in rows])
        for signals in (problem.inputs, problem.outputs)
    )
    return Trajectory(u, y, problem.sampling_time, "test")


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, help="folder of zoo.py with its runs and problems")
    runs: Path = parser.parse_args().runs
    found = {
        name.stem: errors(name.with_suffix(""), runs / "problems" / name.stem)
        for name in sorted(runs.glob("*.json"))
    }
    print(f"| rule | {' | '.join(found)} | stack, mean | model to use, mean |")
    print("|---" * (len(found) + 3) + "|")
    for rule in RULES:
        pairs = [one[rule] for one, _ in found.values()]
        means = [f"{geometric_mean(column):.3f}" for column in zip(*pairs, strict=True)]
        print(
            f"| {rule} | {' | '.join(f'{named:.2f}' for _, named in pairs)} | {' | '.join(means)} |"
        )
    print(f"\n| winner | {' | '.join(found)} | mean |")
    print("|---" * (len(found) + 2) + "|")
    for rule in WINNERS:
        ratios = [one[rule] for _, one in found.values()]
        cells = [f"{ratio:.2f}" for ratio in ratios]
        print(f"| {rule} | {' | '.join(cells)} | {geometric_mean(ratios):.3f} |")


if __name__ == "__main__":
    main()
