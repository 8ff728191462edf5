"""The linear reference of a search on measured and synthetic systems: V, order, delay, seconds.

Everything runs in this process, without a sandbox. `test` is the error of a fit to all training
records on the test records, in their standard deviations; it is computed for the directories in
`--zoo` alone, which are there for development.

    python benchmarks/models/linear_reference.py --zoo DATA/zoo
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import numpy as np
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.references import best_linear
from asia.judge.scoring.outcome import Score, score_outputs
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem, prepared
from asia.recipe import read_recipe

BUILT_IN = ("two_tanks_sim", "cascaded_tanks", "nanodrone", "wiener_hammerstein")


def synthetic() -> Iterator[Problem]:
    """An integrating drive with friction, two lightly damped modes, slow lags with transport."""
    base = load_problem("two_tanks_sim")
    rng = np.random.default_rng(5)

    def problem(name: str, u: np.ndarray, y: np.ndarray, noise: float) -> Problem:
        y = y + noise * y.std() * rng.normal(size=y.shape)
        record = Trajectory(u[:, None], y[:, None], 1.0, name)
        rule = replace(base.protocol, folds=replace(base.protocol.folds, count=3))
        return replace(
            base, name=name, train=(record,), inputs=(Signal("u"),), outputs=(Signal("y"),),
            physics=None, symmetry={}, protocol=rule,
        )  # fmt: skip

    reference = np.repeat(rng.uniform(-1, 1, 60), 50)
    position, speed, force = 0.0, 0.0, np.zeros(3000)
    positions = np.zeros(3000)
    for k in range(3000):
        positions[k] = position
        force[k] = np.clip(2.0 * (reference[k] - position) - 3.0 * speed, -2, 2)
        speed += 0.05 * (force[k] - 0.8 * speed - 0.15 * np.tanh(20 * speed))
        position += 0.05 * speed
    yield problem("drive", force, positions, 0.002)
    u = rng.normal(size=1500)
    modes = ((1.0, 0.985, 0.25), (0.5, 0.98, 0.9))
    y = np.sum([lfilter([0, g], [1, -2 * r * np.cos(w), r * r], u) for g, r, w in modes], axis=0)
    yield problem("two_modes", u, y, 0.03)
    steps = np.repeat(rng.uniform(-1, 1, 60), 30)
    lags = (([0] * 8 + [0.05], 0.95), ([0, 0.006], 0.98))
    y = np.sum([lfilter(b, [1, -pole], steps) for b, pole in lags], axis=0)
    yield problem("exchanger", steps, y, 0.05)


class InProcess:
    """Evaluator of a search without its sandbox, as far as `best_linear` needs one."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.context = problem, search_context(problem, 0)
        self.sources, self.outcomes = dict[int, str](), list[Any]()
        self.data = SimpleNamespace(horizon=problem.protocol.horizon)
        self.folds = make_folds(prepared(problem, problem.train), problem.protocol)

    def fitted(self, source: str, records: Sequence[Trajectory], context: Context) -> Any:
        """Model that a candidate's source fits to these records."""
        module = ModuleType("candidate")
        exec(compile(source, "candidate.py", "exec"), module.__dict__)
        return module.__dict__["fit"](records, context)

    def evaluate(self, source: str) -> Any:
        """Evaluate a source as the judge does."""
        outputs, findings = list[list[np.ndarray]](), list[Any]()
        for fold in self.folds:
            model = self.fitted(source, fold.train, replace(self.context, seed=fold.index))
            cases = list(fold.held_out)
            outputs.append([
                model.simulate(c.past_u[None], c.past_y[None], c.u[None])[0] for c in cases
            ])  # fmt: skip
            findings.append(SimpleNamespace(parameters=tuple(model.parameters().items())))
        outcome = score_outputs(self.folds, outputs, self.problem.protocol.metric)
        self.sources[id(outcome)] = source
        self.outcomes.append(outcome)
        return SimpleNamespace(outcome=outcome, folds=findings, failed_checks=())


def row(problem: Problem, folder: Path | None) -> tuple[str, float]:
    """Row of the table, and V."""
    begun = time.perf_counter()
    judge = InProcess(problem)
    found = best_linear(cast(Any, judge))
    seconds = time.perf_counter() - begun
    score = found.outcome
    assert isinstance(score, Score), score
    test = "-"
    if folder is not None:
        source, records = judge.sources[id(score)], prepared(problem, problem.train)
        model = judge.fitted(source, records, judge.context)
        names = [s.name for s in problem.inputs], [s.name for s in problem.outputs]
        record = np.genfromtxt(folder / "test.csv", delimiter=",", names=True)
        u, y = (np.stack([record[n] for n in one], axis=1) for one in names)
        past = problem.protocol.past
        simulated = model.simulate(u[None, :past], y[None, :past], u[None, past:])[0]
        squares = (((simulated - y[past:]) / y[past:].std(axis=0)) ** 2).mean()
        test = f"{np.sqrt(squares):.4f}"
    folds = ", ".join(f"{fold.value:.4f}" for fold in score.folds)
    recipe = read_recipe(found.source)
    settings = "baseline" if recipe is None else ", ".join(f"{k} {v}" for k, v in recipe.config)
    line = f"| {problem.name} | {score.value:.4f} | {folds} | {settings} | {test} | {seconds:.0f} |"
    return line, score.value


def main() -> None:
    """Print the table and the geometric mean of V."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--zoo", type=Path, help="folder of problem directories")
    parser.add_argument("--only", nargs="+", help="names of systems")
    options = parser.parse_args()
    folders = sorted(p.parent for p in options.zoo.glob("*/problem.toml")) if options.zoo else []
    print("| system | V | folds | settings | test | s |\n|---|---|---|---|---|---|")
    values: list[float] = []
    jobs: list[tuple[Any, Path | None]] = [(str(folder), folder) for folder in folders]
    jobs += [(name, None) for name in BUILT_IN]
    jobs += [(problem, None) for problem in synthetic()]
    for source, folder in jobs:
        name = folder.name if folder else source if isinstance(source, str) else source.name
        if options.only and name not in options.only:
            continue
        problem = load_problem(source) if isinstance(source, str) else source
        line, value = row(problem, folder)
        print(line, flush=True)
        values.append(value)
    print(f"\nGeometric mean of V over {len(values)} systems: {np.exp(np.log(values).mean()):.4f}")


if __name__ == "__main__":
    main()
