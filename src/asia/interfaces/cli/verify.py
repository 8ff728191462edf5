"""asia verify: check the ledger, or repeat the search."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunName, RunOptions
from asia.ledger.artifacts import Store

if TYPE_CHECKING:
    from asia.judge.sandbox.types import Isolation
    from asia.search.replay import Replayed


def verify(
    *,
    run: RunName = None,
    replay: Annotated[
        bool,
        typer.Option(
            "--replay",
            help="Repeat the search instead: query the agent and evaluate every candidate again. "
            "Needs no network and no key, and writes nothing.",
        ),
    ] = False,
    from_scratch: Annotated[
        bool,
        typer.Option(
            "--from-scratch",
            help="With --replay on another machine: compare within --tolerance, not bitwise.",
        ),
    ] = False,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Relative difference of V allowed with --from-scratch.")
    ] = 0.01,
    trust_agent: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODULE:CLASS",
            help="With --replay: import this agent class, which the ledger names; repeatable. "
            "Built-in agents and those of installed packages need no trust.",
        ),
    ] = None,
    options: RunOptions,
) -> None:
    """Check the hash chain of the ledger, every artifact that it names, and V.

    V and the test errors are recomputed from the stored simulations, if the data of the problem are
    still there. Keep a copy of the head, the hash of the last line: only the head shows whether
    lines at the end were removed. --replay does not evaluate experiments that the deadline
    affected. Exit code 1: an outcome differs.
    """
    from asia.ledger.verification import verify as verify_run
    from asia.search.scores import ScoreCheck

    if from_scratch and not replay:
        raise UserError("--from-scratch belongs to --replay: add --replay or leave it out")
    for name, value in (("trust-agent", trust_agent), ("isolation", options.isolation)):
        if value and not replay:
            raise UserError(f"--{name} belongs to --replay: add --replay or leave it out")
    directory = options.directory(run)
    if replay:
        level = options.level
        scratch = tolerance if from_scratch else 0.0
        _replay(directory, scratch, trust_agent or (), level, json=options.json)
        return
    alone = not Store(directory / "artifacts").kept
    scores = ScoreCheck(directory)
    found = verify_run(directory, ledger_alone=alone, check=None if alone else scores)
    reason = "the simulations are not in this folder" if alone else scores.not_recomputed
    if options.json:
        counts = {"experiments": scores.experiments, "tested": scores.tested}
        recomputed = {**counts, "reason": reason, "test_reason": scores.test_not_compared}
        result = {"run": directory.name, "ledger_alone": alone, **asdict(found)}
        say(jsonlib.dumps({**result, "recomputed": recomputed}))
        return
    if alone:
        say(f"{directory.name}: {found.records} events verify")
        say("no artifacts checked: sources, models and simulations are not in this folder")
    else:
        say(f"{directory.name}: {found.records} events and {found.artifacts} artifacts verify")
    if reason:
        say(f"V not recomputed: {reason}")
    else:
        tests = f", test errors of {scores.tested} models" if scores.tested else ""
        say(f"recomputed from the simulations: V of {scores.experiments} experiments{tests}")
    if scores.test_not_compared:
        say(f"test outputs not compared with the test data: {scores.test_not_compared}")
    say(f"head {found.head}")
    if found.torn:
        say(f"the last line is incomplete: its {found.torn} bytes were ignored")


def _replay(
    directory: Path, tolerance: float, trusted: Collection[str], level: Isolation, *, json: bool
) -> None:
    """Query the agent and evaluate every candidate again. Exit code 1 if an outcome differs by more
    than `tolerance` of V; 0.0: bitwise."""
    from asia.search.replay import replay_run

    def replayed(item: Replayed) -> None:
        if json:
            line = {"event": "replayed", **asdict(item), "agrees": item.agrees}
            say(jsonlib.dumps(line), flush=True)
            return
        # `#07 agrees   outcome same    proposal same    keep     V=0.131`: one greppable line.
        found = f"V={item.V:.6g}" if item.V is not None else ""
        near = f"apart {item.apart:.1e}" if item.apart is not None and item.apart > 0 else ""
        parts = (f"{item.status or '':<7}", found, near, item.detail)
        words = "  ".join(part for part in parts if part)
        asked = "" if item.proposal == "none" else f"proposal {item.proposal}"
        say(
            f"{item.name:<23} {'agrees' if item.agrees else 'DIFFERS':<7}  "
            f"outcome {item.outcome:<10}  {asked:<16}  {words}".rstrip(),
            flush=True,
        )

    report = replay_run(directory, replayed, tolerance, trusted=trusted, isolation=level)
    compared = [i for i in report.items if i.outcome not in ("exempt", "unfinished")]
    agree = sum(i.agrees for i in compared)
    exempt = sum(i.outcome == "exempt" for i in report.items)
    taken = sum(i.proposal == "taken" for i in report.items if i.name.startswith("#"))
    if json:
        summary = {
            "run": report.run,
            "agrees": report.agrees,
            "compared": len(compared),
            "agree": agree,
            "exempt": exempt,
            "taken": taken,
            "exchanges": report.exchanges,
            "tolerance": report.tolerance,
            "apart": report.apart,
            "notes": list(report.notes),
        }
        say(jsonlib.dumps({"event": "done", **summary}), flush=True)
    else:
        for note in report.notes:
            say(f"note  {note}", file=sys.stderr)
        within = "bitwise"
        if report.tolerance:
            within = f"within {report.tolerance:g} of V; the largest difference is "
            within += f"{report.apart:.1e}"
        say(
            f"replayed {report.run}: {agree} of {len(compared)} agree {within}"
            + (f", {exempt} left to the deadline" if exempt else "")
            + (f", {taken} proposals taken from the ledger" if taken else "")
            + (f", {report.exchanges} requests answered from it" if report.exchanges else "")
        )
    if not report.agrees:
        raise typer.Exit(1)
