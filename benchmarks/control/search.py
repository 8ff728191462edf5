"""Costs of a controller search beside its references in the same run: inputs held, relay tuning,
`asia control`, and PID loops by differential evolution, the first experiment.

    python benchmarks/control/search.py two_tanks_control quadruple_tank_control --experiments 6

Prints a table for each problem: V in held-out scenarios, and the error in the sealed ones of the
winner. A run that was interrupted goes on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import asia
from asia.judge.scoring.outcome import Score
from asia.ledger.events import TestedModel
from asia.search.unsealing import unseal


def main() -> None:
    """Search, unseal and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+")
    parser.add_argument("--experiments", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    given = parser.parse_args()
    for problem in given.problems:
        run = asia.run(problem, experiments=given.experiments, seed=given.seed, runs=given.runs)
        best = run.view.best
        assert best is not None
        assert best.score is not None
        rows = [(r.name, r.outcome) for r in run.view.references]
        for e in run.view.finished:
            name = f"#{e.number:02d} {e.proposed.title}"
            rows.append((name, e.result.outcome if e.result else None))
        print(f"\n{problem}\n\n| controller | V | over the best |\n|---|---|---|")
        for name, outcome in rows:
            if isinstance(outcome, Score):
                ratio = outcome.value / best.score.value
                print(f"| {name} | {outcome.value:.4f} | {ratio:.2f} |")
            else:
                print(f"| {name} | {outcome.reason.value if outcome else 'none'} | |")
        opened = unseal(run.directory).record
        if isinstance(opened.refit, TestedModel):
            pairs = zip(opened.channels, opened.refit.scores[0].per_channel, strict=True)
            print("sealed scenarios:", ", ".join(f"{name} {value:.4g}" for name, value in pairs))


if __name__ == "__main__":
    main()
