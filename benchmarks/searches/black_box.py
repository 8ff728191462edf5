"""The built-in benchmarks without their equations: V of the expert where [physics] is taken out.

This is what a person with nothing but records gets. Nothing here opens the test.

    python benchmarks/searches/black_box.py cascaded_tanks nanodrone --experiments 15 --runs runs
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

from asia.agents import make_agent
from asia.ledger import open_run
from asia.problem.load import load_problem
from asia.search import prepare, search


def main() -> None:
    """Run the searches that are not there yet and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("problems", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--agent", default="expert")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    options = parser.parse_args()
    print("| problem | seed | V | folds | family | experiment | wall min |")
    print("|---|---|---|---|---|---|---|")
    for name in options.problems:
        problem = load_problem(name)
        budget = replace(problem.budget, experiments=options.experiments)
        problem = replace(problem, physics=None, budget=budget)
        for seed in options.seeds:
            start = time.monotonic()
            agent = make_agent(options.agent)
            run = f"{name}-black-box-{options.agent}-s{seed}"
            ready = prepare(problem, agent.name, seed=seed, runs=options.runs, name=run)
            search(ready, agent, lambda *_: None, lambda _: None)
            minutes = (time.monotonic() - start) / 60
            best = open_run(options.runs / run).view.best
            if best is None or best.score is None:
                raise SystemExit(f"{run}: no candidate has a score")
            folds = ", ".join(f"{f.value:.3f}" for f in best.score.folds)
            print(
                f"| {name} | {seed} | {best.score.value:.4f} | {folds} | {best.proposed.title} | "
                f"{best.number} | {minutes:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
