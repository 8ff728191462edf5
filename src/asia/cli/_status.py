"""asia status: where a run stands."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from asia.cli._options import DEFAULT_RUNS, Json, RunName, Runs

if TYPE_CHECKING:
    from asia.ledger import Run


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("status")(status)


def status(run: RunName = None, runs: Runs = DEFAULT_RUNS, json: Json = False) -> None:
    """Where a run stands: state, experiments, best so far."""
    from asia.ledger import find_run, open_run

    opened = open_run(find_run(runs, run))
    if json:
        print(jsonlib.dumps(_object(opened), allow_nan=False))
    else:
        _print(opened)


def _object(opened: Run) -> dict[str, Any]:
    from asia.ledger import control
    from asia.scoring import Score

    view, best = opened.view, opened.view.best
    beside = control(opened)
    return {
        "run": view.started.run,
        "problem": view.started.problem,
        "agent": view.started.agent,
        "seed": view.started.seed,
        "state": opened.state,
        "stopped": view.stopped.reason if view.stopped else None,
        "usage": asdict(view.usage) if view.usage else None,
        "experiments": len(view.finished),
        "budget": view.budget,
        "isolation": view.started.isolation,
        "early_stopping": view.started.early_stopping,
        "validation_scores": view.validation_scores,
        "best": {"experiment": best.number, "V": best.score.value} if best and best.score else None,
        "control": None
        if beside is None
        else {"run": beside.run, "V": beside.value, "experiments": beside.experiments},
        "rungs": {
            r.name: r.outcome.value if isinstance(r.outcome, Score) else None for r in view.rungs
        },
    }


def _print(opened: Run) -> None:
    from asia.cli._format import (
        duration,
        experiment_line,
        rung_value,
        stop_words,
        told,
        usage_words,
    )
    from asia.ledger import control, control_words

    view, beside = opened.view, control(opened)
    print(
        f"run {view.started.run}  problem {view.started.problem}  agent {view.started.agent}  "
        f"seed {view.started.seed}  isolation {view.started.isolation}"
    )
    print(
        f"{opened.state}: {len(view.finished)} of {view.budget} experiments in "
        f"{duration(view.seconds)}"
    )
    if view.stopped is not None:
        words = stop_words(view.stopped.reason, view)
        print(f"stopped: {words}" + (f" ({view.stopped.detail})" if view.stopped.detail else ""))
    if view.usage is not None:
        print(f"agent   {usage_words(view.usage)}")
    if view.started.early_stopping == "validation":
        print(f"V is {told(view)}")
    if view.unsealed is not None:
        print(f"the test was opened: asia unseal {opened.name} shows the result again")
    if beside is not None:
        print(f"control {control_words(beside, view.started)}")
    for rung in view.rungs:
        print(f"rung    {rung.name:<18} V={rung_value(rung)}")
    for experiment in view.finished:
        print(experiment_line(experiment, view))
