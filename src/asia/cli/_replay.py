"""asia replay: does a search come out the same?"""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Json, RunName, Runs

if TYPE_CHECKING:
    from asia.search import Replayed, ReplayReport

DIFFERS = 1


def replay(
    run: RunName = None,
    from_scratch: Annotated[
        bool,
        typer.Option(help="On another machine: outcomes agree within --tolerance, not bitwise."),
    ] = False,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Relative difference of V allowed with --from-scratch.")
    ] = 0.01,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Repeat a search from its ledger: ask the agent and evaluate every candidate again, compare.

    Needs no network and no key, and writes nothing. Experiments that the deadline affected are
    not evaluated again. Exit code 1: something differs.
    """
    from asia.search import replay_run

    directory = run_directory(runs, run)
    show = _print_json if json else _print
    report = replay_run(directory, show, tolerance if from_scratch else 0.0)
    if json:
        say(jsonlib.dumps({"event": "done", **_summary(report)}), flush=True)
    else:
        _finish(report)
    if not report.agrees:
        raise typer.Exit(DIFFERS)


def _print_json(item: Replayed) -> None:
    say(jsonlib.dumps({"event": "replayed", **asdict(item), "agrees": item.agrees}), flush=True)


def _print(item: Replayed) -> None:
    """`#07 agrees   outcome same    proposal same    keep     V=0.131`: one greppable line."""
    found = f"V={item.V:.6g}" if item.V is not None else ""
    close = item.apart is not None and item.apart > 0
    near = f"apart {item.apart:.1e}" if close else ""
    parts = (f"{item.status or '':<7}", found, near, item.detail)
    words = "  ".join(part for part in parts if part)
    asked = "" if item.proposal == "none" else f"proposal {item.proposal}"
    say(
        f"{item.name:<23} {'agrees' if item.agrees else 'DIFFERS':<7}  "
        f"outcome {item.outcome:<10}  {asked:<16}  {words}".rstrip(),
        flush=True,
    )


def _finish(report: ReplayReport) -> None:
    summary = _summary(report)
    for note in report.notes:
        say(f"note  {note}", file=sys.stderr)
    if report.tolerance:
        within = f"within {report.tolerance:g} of V; the largest difference is {report.apart:.1e}"
    else:
        within = "bitwise"
    taken = summary["taken"]
    say(
        f"replayed {report.run}: {summary['agree']} of {summary['compared']} agree {within}"
        + (f", {summary['exempt']} left to the deadline" if summary["exempt"] else "")
        + (f", {taken} proposals taken from the ledger" if taken else "")
        + (f", {report.exchanges} requests answered from it" if report.exchanges else "")
    )


def _summary(report: ReplayReport) -> dict[str, object]:
    compared = [i for i in report.items if i.outcome not in ("exempt", "unfinished")]
    experiments = [i for i in report.items if i.name.startswith("#")]
    return {
        "run": report.run,
        "agrees": report.agrees,
        "compared": len(compared),
        "agree": sum(i.agrees for i in compared),
        "exempt": sum(i.outcome == "exempt" for i in report.items),
        "taken": sum(i.proposal == "taken" for i in experiments),
        "exchanges": report.exchanges,
        "tolerance": report.tolerance,
        "apart": report.apart,
        "notes": list(report.notes),
    }
