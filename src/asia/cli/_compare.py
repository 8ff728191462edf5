"""asia bench agents: agents against each other at equal budgets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli._bench import chosen_seeds, load_compared, print_result
from asia.cli._options.shared import DEFAULT_RUNS, Json, ProblemName, Runs
from asia.cli._output.comparison import Lines

if TYPE_CHECKING:
    from asia.bench import Arm

LISTS = ("--seeds",)

Agents = Annotated[
    str,
    typer.Option(
        help="Agents by name or module:Class, or relays such as expert*5+bayes, with commas "
        "between them."
    ),
]


def compare_agents(
    problem: ProblemName,
    agents: Agents = "expert,random,bayes",
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N | S S ...",
            help=(
                "One number: the number of seeds, from 0 on (default 5). Several numbers: the "
                "seeds."
            ),
        ),
    ] = None,
    experiments: Annotated[
        int | None,
        typer.Option(min=1, help="Candidates for each search; default the problem's number."),
    ] = None,
    early_stopping: Annotated[
        str | None, typer.Option(help="inner, or validation; default the problem's.")
    ] = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Compare agents: a search with each agent and each seed at the same budget.

    Prints the experiments that each needs to reach the best V of the others, a paired test, and
    curves with bands. After an interrupt, the same command continues.
    """
    from asia.bench import ComparisonPlan, bench
    from asia.search import with_early_stopping

    names = [name.strip() for name in agents.split(",") if name.strip()]
    arms = tuple(_arm(name) for name in names)
    loaded, _ = load_compared(problem)
    if early_stopping is not None:
        loaded = with_early_stopping(loaded, early_stopping)
    plan = ComparisonPlan(
        problem=loaded,
        arms=arms,
        seeds=chosen_seeds(seeds, 5),
        runs=runs,
        settings=(loaded.protocol.early_stopping,),
        experiments=experiments,
        word="compare",
    )
    lines = Lines(json)
    lines.head(plan)
    result = bench(plan, lines)
    print_result(result, json=json)


def _arm(name: str) -> Arm:
    from asia.agents import choose_agent
    from asia.bench import Arm

    chosen = choose_agent(name)
    return Arm(chosen.agent.name, name, lambda: choose_agent(name).agent, settings=chosen.settings)
