"""V of an agent on built-in problems over several seeds, with their equations or without.

Without equations is what a user with nothing but records gets. Nothing here opens a test.

    python benchmarks/searches/builtin.py cascaded_tanks --seeds 0 1 2 --runs runs
    python benchmarks/searches/builtin.py cascaded_tanks nanodrone --without-equations --runs runs
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from pathlib import Path

from asia.agents import make_agent
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from harness import number, option_parser, table

PUBLISHED = {"cascaded_tanks": 0.250}
"""V of Piga and Forgione, best of 15, early stopping on the validation fold, which ours does not
see. Their baseline has 0.681."""


def main() -> None:
    """Run the searches that are not there yet and print the table."""
    parser = option_parser(__doc__)
    parser.add_argument("problems", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--agent", default="expert")
    parser.add_argument("--without-equations", action="store_true")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    options = parser.parse_args()
    rows: list[list[str]] = []
    for name in options.problems:
        problem = load_problem(name)
        problem = replace(problem, budget=replace(problem.budget, experiments=options.experiments))
        if options.without_equations:
            problem = replace(problem, physics=None)
        values: list[float] = []
        for seed in options.seeds:
            kind = "-black-box" if options.without_equations else ""
            run = f"{name}{kind}-{options.agent}-s{seed}"
            start, agent = time.monotonic(), make_agent(options.agent)
            ready = prepare(problem, agent.name, seed=seed, runs=options.runs, name=run)
            search(ready, agent, lambda *_: None, lambda _: None)
            minutes = (time.monotonic() - start) / 60
            view = open_run(options.runs / run).view
            if view.best is None or view.best.score is None:
                raise SystemExit(f"{run}: no candidate has a score")
            values.append(view.best.score.value)
            linear = {r.name: r.outcome for r in view.references}.get("linear model")
            baseline = view.experiment(1).score
            rows.append(
                [name, str(seed), f"{values[-1]:.4f}",
                 ", ".join(f"{fold.value:.3f}" for fold in view.best.score.folds),
                 view.best.proposed.title, str(view.best.number),
                 number(baseline.value if baseline else None),
                 number(getattr(linear, "value", None)), f"{minutes:.1f}"]
            )  # fmt: skip
        middle = statistics.median(values)
        ratio = "" if name not in PUBLISHED else f"{middle / PUBLISHED[name]:.2f} of the published"
        rows.append([f"**{name}**", "median", f"{middle:.4f}", ratio, *[""] * 5])
    heads = "problem", "seed", "V", "folds", "candidate", "experiment"
    print(table([*heads, "baseline V", "linear V", "wall min"], rows))


if __name__ == "__main__":
    main()
