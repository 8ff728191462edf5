"""asia bench agents: a comparison of agents at equal budgets."""

from __future__ import annotations

import json as jsonlib
import statistics
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import printable_line, say, say_lines
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, ProblemName, Runs
from asia.ledger.chain import write_whole
from asia.ledger.events import Evaluated
from asia.presentation.experiments import experiment_line
from asia.presentation.table import error_value

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from asia.agents.registry import NamedAgent
    from asia.analysis.comparison import Pair, Reached, Row
    from asia.ledger.events import Event
    from asia.ledger.view import SearchView
    from asia.problem.problem import Problem

LISTS = ("--seeds",)
_DEFAULT_SEEDS = 5


def compare_agents(
    problem: ProblemName,
    agents: Annotated[
        str,
        typer.Option(help="Agents by name or module:Class, with commas between them."),
    ] = "expert,random,bayes",
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N | S S ...",
            help=f"One number: the number of seeds, from 0 on (default {_DEFAULT_SEEDS}). Several "
            "numbers: the seeds.",
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
    from asia.agents.registry import choose_agent
    from asia.analysis.comparison import experiments_to_reach, pairs_of, plan_searches, rows_of
    from asia.problem.load import load_problem
    from asia.search.settings import SearchSettings

    def named(name: str) -> tuple[str, Callable[[], NamedAgent]]:
        return choose_agent(name).agent.name, lambda: choose_agent(name)

    loaded = SearchSettings(early_stopping=early_stopping).applied(load_problem(problem))
    compared = [named(name.strip()) for name in agents.split(",") if name.strip()]
    searches = plan_searches(loaded, compared, _chosen_seeds(seeds), experiments)
    file = sys.stderr if json else sys.stdout

    def on_event(event: Event, view: SearchView) -> None:
        if isinstance(event, Evaluated):
            say(experiment_line(view.experiment(event.experiment), view), file=file, flush=True)

    views: dict[tuple[str, int], SearchView] = {}
    for number, search in enumerate(searches, start=1):
        say(file=file)
        say(f"[{number}/{len(searches)}] {search.run}", file=file, flush=True)
        view = views[search.agent, search.seed] = search.search(runs, on_event)
        value = view.best_value
        text = "no candidate has a score" if value is None else f"best V {error_value(value)}"
        say(f"    {text} after {len(view.finished)} experiments", file=file, flush=True)
        if json:
            found = {
                "event": "run",
                "run": search.run,
                "agent": search.agent,
                "seed": search.seed,
                "experiments": len(view.finished),
                "V": value,
            }
            say(jsonlib.dumps(found, allow_nan=False), flush=True)
    rows, reached, pairs = rows_of(views), experiments_to_reach(views), pairs_of(views)
    setting = loaded.protocol.early_stopping
    directory = runs / f"compare-{loaded.name}-{setting}"
    document = directory / "comparison.md"
    shown = any(view.started.residuals == "held_out" for view in views.values())
    tables = [_v_table(rows, reached, validation=setting == "validation", shown=shown)]
    if pairs:
        tables.append(_pair_table(pairs, len({seed for _, seed in views})))
    text = "\n".join([f"# {loaded.name}: agents at equal budgets\n", *tables])
    write_whole(document, text.encode(), durable=False)
    pictures = _draw(loaded, views, directory)
    if not json:
        say()
        say_lines("\n".join(tables))
        say(f"tables   {document}")
        say(f"picture  {pictures[0]}")
        return
    done = {
        "event": "done",
        "early_stopping": setting,
        "rows": [{**asdict(row), "V": row.median} for row in rows],
        "reached": [asdict(one) for one in reached],
        "pairs": [{**asdict(pair), "p": pair.p} for pair in pairs],
        "document": str(document),
        "pictures": [str(path) for path in pictures],
    }
    say(jsonlib.dumps(done, allow_nan=False))


def _chosen_seeds(given: list[int] | None) -> tuple[int, ...]:
    """Return the seeds for `--seeds N` (0 to N - 1) or `--seeds S S ...`."""
    if given is None:
        return tuple(range(_DEFAULT_SEEDS))
    if min(given) < 0 or given == [0]:
        raise UserError(
            f"--seeds {' '.join(str(s) for s in given)}: expected how many seeds (3 for 0, 1, 2), "
            "or several seeds (0 1 2), none below 0"
        )
    return tuple(range(given[0])) if len(given) == 1 else tuple(given)


def _draw(
    problem: Problem, views: Mapping[tuple[str, int], SearchView], directory: Path
) -> tuple[Path, ...]:
    """Draw V of every experiment of every search, and the linear model's."""
    from asia.judge.evaluation.references import LINEAR_REFERENCE
    from asia.judge.scoring.outcome import Score
    from asia.report.files import save
    from asia.report.pictures.progress import draw_comparison

    curves: dict[str, list[list[float | None]]] = {}
    for (agent, _), view in views.items():
        curves.setdefault(agent, []).append([e.value for e in view.finished])
    references = next(iter(views.values())).references
    levels = {
        one.name: one.outcome.value
        for one in references
        if one.name == LINEAR_REFERENCE and isinstance(one.outcome, Score)
    }
    title = f"{problem.name}: agents at equal budgets, {problem.protocol.early_stopping} "
    title += "early stopping"
    metric = problem.protocol.metric
    return save([("comparison", lambda: draw_comparison(curves, levels, metric, title))], directory)


# Tables: aligned Markdown that reads as well on a terminal.


def _v_table(
    rows: Sequence[Row], reached: Sequence[Reached], *, validation: bool, shown: bool
) -> str:
    """Write V of every row. shown: agents saw residuals of the held-out folds."""
    title = "V with inner early stopping: nothing of the held-out fold is seen in training"
    header = ["model", "V", "lowest", "highest", "runs"]
    if validation:
        title = "V with validation early stopping: training asks for its score on the held-out "
        title += "fold, so V is not leak-free"
        header.append("scores seen")
    cells: list[list[str]] = []
    for row in rows:
        scored = len(row.values)
        runs = str(row.runs) if scored == row.runs else f"{scored} of {row.runs} scored"
        values = row.median, min(row.values, default=None), max(row.values, default=None)
        found = [row.model, *map(_number, values), runs, str(row.scores_seen)]
        cells.append(found[: len(header)])
    notes: list[str] = []
    if any(row.runs > 1 for row in rows):
        notes.append("V is the median over the runs, one a seed.")
    for one in reached:
        each = ", ".join(
            f"seed {seed}: {'not reached' if count is None else count}"
            for seed, count in one.experiments.items()
        )
        counts = [count for count in one.experiments.values() if count is not None]
        middle = f"; median {statistics.median(counts):g}" if len(counts) > 1 else ""
        notes.append(
            f"Experiments the {one.agent} needed to reach the best V of {one.other}: {each}{middle}"
        )
    if validation:
        notes.append("Scores seen: number of held-out scores that the fits of one V received.")
    title += "; agents saw residuals of the held-out folds" if shown else ""
    return _markdown(title, header, cells, notes)


def _pair_table(pairs: Sequence[Pair], seeds: int) -> str:
    rows: list[list[str]] = []
    for pair in pairs:
        ratios = pair.ratios
        better = f"{sum(r < 1 for r in ratios)} of {len(ratios)}" if ratios else "-"
        ratio = _number(statistics.median(ratios) if ratios else None)
        p = "-" if pair.p is None else f"{pair.p:.2g}"
        rows.append([f"{pair.first} : {pair.second}", str(len(ratios)), better, ratio, p])
    notes = [
        "V ratio: first over second, below 1 where the first is better. p: two-sided signed-rank "
        f"test over the seeds; with {seeds} it cannot be below {min(1.0, 2.0 ** (1 - seeds)):.2g}."
    ]
    if seeds < 6:
        notes.append("With fewer than 6 seeds no difference can be significant at 5 %.")
    header = ["pair", "seeds", "first better", "median V ratio", "p"]
    return _markdown("Paired by seed", header, rows, notes)


def _number(value: float | None) -> str:
    return "-" if value is None else error_value(value)


def _markdown(
    title: str, header: list[str], rows: Sequence[list[str]], notes: Sequence[str]
) -> str:
    """Write title, aligned table and notes."""
    # Names of agents and signals neither end a row nor make a column.
    cells = [[printable_line(text).replace("|", "\\|") for text in row] for row in (header, *rows)]
    widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])])
    lines = [
        f"| {' | '.join([first.ljust(widths[0]), *map(str.rjust, rest, widths[1:])])} |"
        for first, *rest in cells
    ]
    return "\n".join([f"## {title}", "", *lines, *(f"\n{note}" for note in notes)]) + "\n"
