"""asia bench suite: every benchmark next to its board."""

from __future__ import annotations

import json as jsonlib
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._text import one_line, say, say_lines
from asia.cli._options.shared import DEFAULT_RUNS, Json, Runs, YesProcess
from asia.cli._output.comparison import Lines

if TYPE_CHECKING:
    from asia.bench import ComparisonPlan
    from asia.bench.suite import SuiteResult


class SuiteLines(Lines):
    """Lines of each search, and one line per benchmark."""

    def on_benchmark(self, plan: ComparisonPlan) -> None:
        """Print the name of the benchmark."""
        self.head(plan)

    def on_left_out(self, name: str, reason: str) -> None:
        """Print the reason."""
        self.print(f"{name} is left out: {one_line(reason)}")


def suite(
    only: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Some of the benchmarks; default all.")
    ] = None,
    experiments: Annotated[
        int | None,
        typer.Option(min=1, help="Candidates for each search; default the problem's number."),
    ] = None,
    unseal: Annotated[
        bool, typer.Option("--unseal", help="At the very end, open the sealed tests.")
    ] = False,
    yes_process: YesProcess = False,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Search every benchmark once with the expert, and print the results next to its board.

    Without --unseal no test is opened. After an interrupt, the same command continues.
    """
    from asia.bench.suite import SuitePlan, bench_suite, select_problems

    plan = SuitePlan(select_problems(only), runs, experiments)
    lines = SuiteLines(json)
    result = bench_suite(plan, lines, open_test=unseal, process_consent=yes_process)
    if json:
        say(jsonlib.dumps({"event": "done", **_as_object(result)}, allow_nan=False))
        return
    say()
    say_lines(result.table.markdown())
    say(f"table    {result.document}")
    for picture in result.pictures:
        if picture.suffix == ".png":
            say(f"picture  {picture}")


def _as_object(result: SuiteResult) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for r in result.results:
        standings = r.board.standings if r.board else ()
        found[r.name] = {
            "V": r.value,
            "experiments": r.experiments,
            "left_out": r.left_out or None,
            "unit": r.board.unit if r.board else None,
            "figures": {
                s.figure.name: {
                    "value": s.figure.value,
                    "rank": s.rank if s.among > 1 else None,
                    "among": s.among,
                }
                for s in standings
            },
        }
    return {"suite": found, "document": str(result.document)}
