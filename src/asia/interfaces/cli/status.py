"""asia status: the progress of a run."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asia._text import say
from asia._timer import duration
from asia.agents.expert_result import expert_result
from asia.analysis.verdict import alarms, unguarded
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Profile, RunName, Runs, run_directory
from asia.interfaces.cli.output import (
    fact_line,
    print_alarms,
    profile_lines,
    profile_object,
    running_words,
    search_facts,
    verdict_object,
)
from asia.judge.scoring.outcome import Score
from asia.ledger.evidence import incumbent_threshold
from asia.ledger.run import error_of, metric_of, model_to_use, open_run
from asia.presentation.experiments import experiment_line, references_table
from asia.presentation.integrity import guard_text, seal_text
from asia.problem.metrics import metric_label
from asia.search.steering import running_losses

if TYPE_CHECKING:
    from asia.ledger.index import Brief

_EXPERIMENTS_SHOWN = 50


def status(
    run: RunName = None, runs: Runs = DEFAULT_RUNS, profile: Profile = False, json: Json = False
) -> None:
    """Print the progress of a run: state, experiments, best candidate so far."""
    from asia.ledger.index import brief

    directory = run_directory(runs, run)
    found = brief(directory, _EXPERIMENTS_SHOWN)
    events = [line.event for line in open_run(directory).lines] if profile else []
    if json:
        measured = {"profile": profile_object(events)} if profile else {}
        say(jsonlib.dumps({**_status_object(directory, found), **measured}, allow_nan=False))
        return
    _print_status(directory, found)
    for line in profile_lines(events) if profile else ():
        say(line)


def _status_object(directory: Path, found: Brief) -> dict[str, Any]:
    view, start, best = found.view, found.view.started, found.view.best
    compared = expert_result(directory, start, found.finished)
    named = model_to_use(view)
    return {
        "run": start.run,
        "problem": start.problem,
        "agent": start.agent,
        "seed": start.seed,
        "state": found.state,
        "stopped": view.stopped.reason if view.stopped else None,
        "usage": asdict(view.usage) if view.usage else None,
        "experiments": found.finished,
        "budget": view.budget,
        "isolation": start.isolation,
        "isolation_strict": start.isolation_strict,
        "parallel": start.parallel,
        "running": [e.number for e in view.running] if found.state == "running" else [],
        "losses": running_losses(directory, view) if found.state == "running" else {},
        "metric": metric_of(directory),
        "early_stopping": start.early_stopping,
        "residuals": start.residuals,
        "validation_scores": found.validation_scores,
        "best": {"experiment": best.number, "V": best.score.value} if best and best.score else None,
        "incumbent": view.incumbent.number if view.incumbent else None,
        "remark": (view.experiments and view.experiments[-1].proposed.remark) or None,
        "error": error_of(directory) if found.state == "interrupted" else None,
        "failed_checks": list(view.failed_checks),
        "alarms": list(alarms(view)),
        "guard": guard_text(view) or None,
        "unguarded": unguarded(view) or None,
        "seal": seal_text(directory, view) or None,
        "threshold": incumbent_threshold(view),
        "verdict": verdict_object(view),
        "use": named.model if named else None,
        "use_reason": named.reason if named else None,
        "confirmed": None if view.confirmed is None else asdict(view.confirmed),
        "validated": [asdict(one) for one in view.validated],
        "control": None
        if compared is None
        else {"run": compared.run, "V": compared.value, "experiments": compared.experiments},
        "references": {
            r.name: r.outcome.value if isinstance(r.outcome, Score) else None
            for r in view.references
        },
    }


def state_words(found: Brief) -> str:
    """Return the state; `waiting for a candidate` for an idle search of a workspace or server."""
    view = found.view
    submitted = view.started.agent in ("workspace", "mcp")
    idle = bool(view.experiments) and view.pending is None and found.finished < view.budget
    if found.state == "running" and submitted and idle:
        return "waiting for a candidate"
    return found.state


def _print_status(directory: Path, found: Brief) -> None:
    view, start = found.view, found.view.started
    print_alarms(view)
    if words := seal_text(directory, view):
        say(fact_line("seal", words))
    say(
        f"run {start.run}  problem {start.problem}  agent {start.agent}  "
        f"seed {start.seed}  isolation {start.isolation_words}"
    )
    say(
        f"{state_words(found)}: {found.finished} of {view.budget} experiments, evaluated in "
        f"{duration(found.seconds)} (without references and refit), "
        f"metric {metric_label(metric_of(directory))}"
    )
    error = error_of(directory) if found.state == "interrupted" else None
    if error is not None:
        say(fact_line("error", error))
    running = found.state == "running"
    for words in running_words(view, running_losses(directory, view)) if running else ():
        say(fact_line("running", words))
    if view.experiments and view.experiments[-1].proposed.remark:
        say(fact_line("remark", view.experiments[-1].proposed.remark))
    for label, text in search_facts(view, directory, found.finished, found.validation_scores):
        say(fact_line(label, text))
    if view.unsealed is not None:
        say(f"the test was opened: asia unseal {directory.name} prints the result")
    for line in references_table(view).lines() if view.references else ():
        say(line)
    shown = view.finished[-_EXPERIMENTS_SHOWN:]
    if shown:
        say(
            "min fit: lowest fit index over folds and outputs, "
            "100 (1 - |y - y_hat| / |y - mean of y|) %"
        )
    if found.finished > len(shown):
        say(f"the last {len(shown)} of {found.finished} experiments; all are in results.tsv")
    for experiment in shown:
        say(experiment_line(experiment, view))
