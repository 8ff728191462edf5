"""Cascaded tanks on real data: V of the expert over several seeds beside the published search.

The published figure used the validation fold for early stopping; ours does not see it. Nothing here
opens the test.

    python benchmarks/searches/tanks.py --seeds 0 1 2 --experiments 15 --runs runs
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from pathlib import Path

from asia.ledger import open_run

PUBLISHED_V = 0.250  # Piga and Forgione: best of 15, early stopping on the validation fold
PUBLISHED_BASELINE = 0.681


def main() -> None:
    """Run the searches that are not there yet and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--agent", default="expert")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    options = parser.parse_args()
    asia = Path(sys.executable).with_name("asia")
    best: list[float] = []
    print("| seed | V | folds | experiment | baseline V | linear V | wall min |")
    print("|---|---|---|---|---|---|---|")
    for seed in options.seeds:
        start = time.monotonic()
        command = [
            asia, "run", "cascaded_tanks", "--agent", options.agent, "--seed", str(seed),
            "--experiments", str(options.experiments), "--runs", options.runs,
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=sys.stderr)
        minutes = (time.monotonic() - start) / 60
        view = open_run(options.runs / f"cascaded_tanks-{options.agent}-s{seed}").view
        if view.best is None or view.best.score is None:
            raise SystemExit(f"seed {seed}: no candidate has a score")
        score = view.best.score
        best.append(score.value)
        folds = ", ".join(f"{f.value:.3f}" for f in score.folds)
        rungs = {r.name: r.outcome for r in view.rungs}
        baseline = view.experiment(1).score
        print(
            f"| {seed} | {score.value:.4f} | {folds} | {view.best.number} | "
            f"{baseline.value if baseline else float('nan'):.3f} | "
            f"{getattr(rungs['linear model'], 'value', float('nan')):.3f} | {minutes:.1f} |"
        )
    median = statistics.median(best)
    print(
        f"\nmedian V {median:.4f}; published {PUBLISHED_V:.3f}: ratio {median / PUBLISHED_V:.2f} "
        f"(published baseline {PUBLISHED_BASELINE})"
    )


if __name__ == "__main__":
    main()
