"""asia verify --replay: repeat a search from its ledger and compare."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from asia._text import say

if TYPE_CHECKING:
    from asia.search.replay import Replayed, ReplayReport

DIFFERS = 1


def replay_search(directory: Path, tolerance: float, *, json: bool) -> None:
    """Repeat a search from its ledger: query the agent and evaluate every candidate again. Exit
    code 1 if an outcome differs by more than `tolerance` of V; 0.0: bitwise."""
    from asia.search.replay import replay_run

    report = replay_run(directory, _print_json if json else _print, tolerance)
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
