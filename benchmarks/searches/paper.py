"""Repeat the comparison of Piga and Forgione: informed search against random search.

The agents are the expert, random draws from the model library, and random draws from the paper's
space; with validation early stopping also the paper's own configurations, rebuilt. The two settings
of early stopping never share a table. The paper's V were measured with `validation`, so they are
only in that table. Nothing here opens a test: the run to open with `asia unseal` is the expert's
with the first seed and `inner`, whatever the others give. The same command resumes.

    python benchmarks/searches/paper.py cascaded_tanks --seeds 0 1 2
    python benchmarks/searches/paper.py nanodrone --seeds 0 --early-stopping inner
"""

from __future__ import annotations

import statistics
import sys
import tomllib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from asia.agents.library.family import FEWEST_STEPS, Family
from asia.agents.library.methods import adam
from asia.agents.library.registry import family
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.random import RandomAgent
from asia.agents.registry import NamedAgent, choose_agent
from asia.agents.view import AgentView, Facts, Proposal
from asia.analysis.comparison import (
    Row,
    experiments_to_reach,
    pairs_of,
    plan_searches,
    row_of,
    rows_of,
)
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.recipe import Recipe
from asia.search.settings import SearchSettings
from harness import number, option_parser, table

HERE = Path(__file__).parent
AGENTS = ("expert", "random", "random-paper")
REFERENCE_SECONDS = 900.0
"""Time of a fit of a rebuilt configuration, which trains for long."""


@dataclass(frozen=True)
class FixedAgent:
    """Proposes the paper's configurations of these names in order."""

    names: tuple[str, ...]
    name: str = "references"

    def propose(self, view: AgentView) -> Proposal | None:
        """The next one; None after the last."""
        done = len(view.trials) - 1
        if done >= len(self.names):
            return None
        source = HERE.parent / "rebuilt" / f"paper_{self.names[done]}.py"
        return Proposal(
            source=source.read_text("utf-8"),
            family="reference",
            title=self.names[done],
            hypothesis="The paper's configuration and recipe, rebuilt.",
            expected="The V that the paper reports, within the spread over seeds.",
        )


class PaperRandom(RandomAgent):
    """The random control of the paper: an LSTM that runs freely on its own output, alone or as the
    residual of the equations, with width, depth, learning rate, dropout and weight decay drawn."""

    def families(self, facts: Facts) -> tuple[Family, ...]:
        """The two model classes, the second where the problem has equations for it; fits are long
        ones, by Adam alone."""
        space = Space(
            config=(Span("hidden", 16, 128, whole=True), OneOf("layers", (1, 2, 3))),
            options=(
                Span("learning_rate", 1e-4, 1e-2),
                Span("dropout", 0.0, 0.3, log=False),
                Span("weight_decay", 1e-6, 1e-2),
            ),
        )

        def start(row: Family, facts: Facts) -> Recipe:
            if row.name == "physics_net":
                config = (("network", "lstm"), ("hidden", 32), ("layers", 1))
                return Recipe("physics_net", config, "Adam", adam(facts, "heavy", "full", 1e-3))
            return row.full(facts).configured(cell="lstm")

        def settle(_: Facts, recipe: Recipe) -> Recipe:
            """Fewer steps for larger networks: an update costs about the square of the width, times
            the layers."""
            larger = recipe.number("layers", 1) * (recipe.number("hidden", 32) / 32) ** 2
            steps = recipe.number("steps", FEWEST_STEPS) / max(1.0, larger)
            return recipe.trained(steps=max(FEWEST_STEPS, round(steps)))

        rows = (family(name) for name in ("autoregressive", "physics_net"))
        return tuple(
            replace(
                row, start=partial(start, row), space=lambda _: space, methods=(), settle=settle
            )
            for row in rows
            if row is not None and row.suits(facts)
        )


def make(name: str) -> NamedAgent:
    """The agent of a name; the ledger keeps that of the paper as `random` in another space."""
    if name == "random-paper":
        return NamedAgent(PaperRandom(), {"space": "paper"})
    return choose_agent(name)


def search_all(
    problem: Problem, agents: list[str], names: tuple[str, ...], options: Any
) -> tuple[dict[tuple[str, int], SearchView], list[SearchView]]:
    """Search with every agent and seed; the views, and those of the rebuilt configurations."""
    made = [(name, partial(make, name)) for name in agents]
    searches = plan_searches(problem, made, options.seeds, options.experiments)
    if names:
        budget = replace(problem.budget, fit_seconds=REFERENCE_SECONDS)
        long = replace(problem, budget=budget)
        fixed = [("references", lambda: NamedAgent(FixedAgent(names)))]
        searches += plan_searches(long, fixed, options.seeds, 1 + len(names))
    views: dict[tuple[str, int], SearchView] = {}
    for search in searches:
        print(search.run, file=sys.stderr, flush=True)
        views[search.agent, search.seed] = search.search(options.runs, lambda *_: None)
    references = [views.pop(("references", seed)) for seed in options.seeds if names]
    return views, references


def print_tables(
    rows: list[Row], views: dict[tuple[str, int], SearchView], published: dict[str, float] | None
) -> None:
    """Print V, the experiments to the V of the others, and the pairs. published: the paper's V."""
    heads = ["model", "V", "lowest", "highest", "scored", "scores seen"]
    cells = [
        [row.model, number(row.median), number(min(row.values, default=None)),
         number(max(row.values, default=None)), f"{len(row.values)} of {row.runs}",
         str(row.scores_seen)]
        for row in rows
    ]  # fmt: skip
    if published is not None:
        heads.append("V paper")
        shown = {row.model.partition(",")[0]: line for row, line in zip(rows, cells, strict=True)}
        for line in cells:
            line.append("-")
        for name, value in published.items():
            if name in shown:
                shown[name][-1] = number(value)
            else:
                cells.append([f"paper only: {name}", *"-----", number(value)])
    print(table(heads, cells))
    for one in experiments_to_reach(views):
        print(f"\nExperiments of {one.agent} to the best V of {one.other}, by seed: "
              f"{dict(one.experiments)}")  # fmt: skip
    for pair in pairs_of(views):
        middle = statistics.median(pair.ratios) if pair.ratios else None
        print(f"\n{pair.first} : {pair.second}, V ratio {number(middle)}, p {number(pair.p)}")


def main() -> None:
    """Run the searches that are not there yet and print the tables."""
    parser = option_parser(__doc__)
    parser.add_argument("problem")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--experiments", type=int, help="default the paper's or the problem's")
    parser.add_argument(
        "--early-stopping", nargs="+", default=["inner", "validation"],
        choices=("inner", "validation"),
    )  # fmt: skip
    parser.add_argument("--agents", nargs="+", default=list(AGENTS))
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    options = parser.parse_args()
    problem = load_problem(options.problem)
    paper = tomllib.loads((HERE / "paper.toml").read_text("utf-8")).get(problem.name, {})
    options.experiments = options.experiments or paper.get("experiments")
    for setting in options.early_stopping:
        validation = setting == "validation"
        names = tuple(paper.get("references", ())) if validation else ()
        own = SearchSettings(early_stopping=setting).applied(problem)
        views, references = search_all(own, options.agents, names, options)
        rows = list(rows_of(views))
        for title in names:
            same = ((e for e in v.experiments if e.proposed.title == title) for v in references)
            rows.append(row_of(f"{title}, rebuilt", (next(one, None) for one in same)))
        print(f"\n## V with {setting} early stopping" + ", not leak-free" * validation + "\n")
        values = {one.get("row", one["model"]): one["value"] for one in paper.get("values", ())}
        print_tables(rows, views, values if validation and values else None)
    for one in paper.get("test", ()):
        print(f"\nTest error of {one['model']}: {one['value']}")
    if "mee" in paper:
        groups = [name for name, *_ in paper["mee"][0]["groups"]]
        heads = [f"{name} {word}" for name in groups for word in ("h10", "h50", "sum")]
        errors = [
            [one["model"], *(f"{value:g}" for group in one["groups"] for value in group[1:])]
            for one in paper["mee"]
        ]
        print(f"\nMean Euclidean Errors on the test\n\n{table(['model', *heads], errors)}")
    print(f"\n{paper.get('protocol', '')}")


if __name__ == "__main__":
    main()
