"""The gate of searches whose agent can read the training records: its power, and honest candidates.

python benchmarks/searches/gate.py power [--draws 400]
python benchmarks/searches/gate.py honest [--seed 0] [--systems linear,duffing] [--out DIR]

power: how large must a gain be to be confirmed in 90 % of cases, by length of the guard records,
and how often a gain that is not there is confirmed. The error of the incumbent is a slow part
(first-order noise with a correlation length) and white noise as large as it. The candidate removes
a share of the slow part, and adds one of its own with a tenth of its standard deviation. Errors are
made, nothing is fitted.

honest: eight honest candidates on each of five synthetic systems, in searches with guard records.
Printed is each new best, whether it truly improves the noise-free error on a record of 1 000
samples that no search has seen, and whether it was confirmed. Resumes where --out is given again.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from asia.data.trajectory import Trajectory
from asia.errors import CandidateError
from asia.judge.scoring.confirmation import ComparedParts, Confirmation, paired_gain
from asia.ledger.artifacts import Store
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import whole
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.guard import simulated
from asia.search.run import guard_share, make_evaluator, prepare, search
from candidates import BASELINE, CANDIDATES, Scripted
from harness import table, words
from systems import KINDS, System, make_system, write_problem

LENGTHS = (50, 100, 200, 500, 1000, 3000)
CORRELATION = 10
SYSTEMS = ("linear", "hammerstein", "duffing", "tanks", "bilinear")


@dataclass(frozen=True)
class Judged:
    """A new best as the gate and the noise-free record judge it."""

    system: str
    title: str
    found: Confirmation
    true_gain: float


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("power", "honest"))
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--systems", type=words(KINDS), default=list(SYSTEMS), metavar="A,B")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.what == "power":
        print(_power(options.draws))
        return
    with tempfile.TemporaryDirectory(prefix="asia-gate-") as scratch:
        out = options.out or Path(scratch)
        judged = [one for name in options.systems for one in _searched(name, options.seed, out)]
    print(_table(judged))


def _errors(rng: np.random.Generator, samples: int) -> np.ndarray:
    """First-order noise of unit variance with the correlation length, (samples,)."""
    pole = np.exp(-1.0 / CORRELATION)
    drive = np.sqrt(1.0 - pole**2) * rng.normal(size=samples + 20 * CORRELATION)
    x = np.zeros(len(drive))
    for k in range(1, len(x)):
        x[k] = pole * x[k - 1] + drive[k]
    return x[20 * CORRELATION :]


def _confirmed(rng: np.random.Generator, samples: int, removed: float, claimed: float) -> bool:
    """Whether the gain of a candidate that removes a share of the slow error is confirmed."""
    slow, own, noise = _errors(rng, samples), _errors(rng, samples), rng.normal(size=samples)
    y = np.zeros((samples, 1))
    before = (slow + noise)[:, None]
    after = ((1.0 - removed) * slow + 0.1 * own + noise)[:, None]
    gain = paired_gain([ComparedParts([y], [before], [after], np.ones(1))], "rmse")
    return Confirmation(1, claimed, gain).confirmed


def _gain(removed: float) -> float:
    """The gain in the expected error."""
    return 1.0 - np.sqrt(((1.0 - removed) ** 2 + 0.01 + 1.0) / 2.0)


def _power(draws: int) -> str:
    rows: list[list[str]] = []
    for samples in LENGTHS:
        rng = np.random.default_rng([samples, 1])
        least = None
        for removed in np.linspace(0.05, 1.0, 39):
            gain = _gain(removed)
            if gain <= 0.0:
                continue
            share = np.mean([_confirmed(rng, samples, removed, gain) for _ in range(draws)])
            if share >= 0.9:
                least = gain
                break
        false = [
            np.mean([_confirmed(rng, samples, 0.0, claimed) for _ in range(draws)])
            for claimed in (0.01, 0.05, 0.2)
        ]
        text = "more than 29 %" if least is None else f"{least:.0%}"
        rows.append([str(samples), text, *(f"{one:.1%}" for one in false)])
    heads = ["samples of the guard", "gain confirmed in 90 % of cases"]
    heads += [f"no gain, {claimed} % claimed: confirmed" for claimed in (1, 5, 20)]
    return table(heads, rows)


def _searched(name: str, seed: int, out: Path) -> list[Judged]:
    system = make_system(KINDS[name], seed)
    directory = write_problem(system, out / "problems" / name, len(CANDIDATES) + 1)
    (directory / "baseline.py").write_text(BASELINE)
    agent = Scripted()
    problem = load_problem(directory, guard_share(agent.name, None))
    problem = replace(problem, budget=replace(problem.budget, patience=99, retests=0))
    ready = prepare(problem, agent.name, seed=seed, runs=out / "runs")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    store = Store(ready.directory / "artifacts")
    found: list[Judged] = []
    for e in view.finished:
        confirmation = e.result.confirmation if e.result else None
        if confirmation is None:
            continue
        before = view.experiment(confirmation.since)
        errors = [_true_error(problem, system, view, store, one) for one in (before, e)]
        one = Judged(name, e.proposed.title, confirmation, 1.0 - errors[1] / errors[0])
        print(_row(one), flush=True)
        found.append(one)
    return found


def _true_error(
    problem: Problem, system: System, view: SearchView, store: Store, e: Experiment
) -> float:
    """Error of the ensemble on the noise-free fresh record, over the spread of the training
    outputs."""
    record = Trajectory(system.test.u, system.test.truth, problem.sampling_time, "fresh")
    blocks = whole([record], problem.protocol)
    evaluator = make_evaluator(problem, view)
    models = [store.get(fold.model) for fold in e.folds]
    try:
        y_hat = simulated(evaluator, store.text(e.proposed.source), models, blocks)
    except CandidateError:
        return float("inf")
    error = blocks[0].y - y_hat[0]
    return float(np.mean(np.sqrt(np.mean(error**2, axis=0)) / evaluator.data.scale))


def _row(one: Judged) -> list[str]:
    guard = one.found.guard
    measured = "-" if guard is None else f"{guard.value:.1%} ({guard.low:.1%} to {guard.high:.1%})"
    sequential = "-" if one.found.sequential is None else f"{one.found.sequential:.1%}"
    return [
        one.system, one.title, f"{one.found.gain:.1%}", measured, sequential,
        f"{one.true_gain:.1%}", "yes" if one.found.confirmed else "no",
    ]  # fmt: skip


def _table(judged: list[Judged]) -> str:
    better = [one for one in judged if one.true_gain > 0.0]
    lost = [one for one in better if not one.found.confirmed]
    wrong = [one for one in judged if one.true_gain <= 0.0 and one.found.confirmed]
    heads = ["system", "candidate", "gain in V", "on the guard", "one by one", "true", "confirmed"]
    return (
        f"{table(heads, map(_row, judged))}\n\n{len(better)} of {len(judged)} new bests truly "
        f"improve, {len(lost)} of them are not confirmed; {len(wrong)} of the others are confirmed"
    )


if __name__ == "__main__":
    main()
