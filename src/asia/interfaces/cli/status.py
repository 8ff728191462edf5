"""asia status: the progress of a run."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Profile, RunName, Runs, run_directory

if TYPE_CHECKING:
    from asia.ledger.index import Brief
    from asia.ledger.view import SearchView

LAST = 50


def status(
    run: RunName = None, runs: Runs = DEFAULT_RUNS, profile: Profile = False, json: Json = False
) -> None:
    """Print the progress of a run: state, experiments, best candidate so far."""
    from asia.interfaces.cli.text import profile_lines, profile_object
    from asia.ledger.index import brief
    from asia.ledger.run import open_run

    directory = run_directory(runs, run)
    found = brief(directory, LAST)
    events = [line.event for line in open_run(directory).lines] if profile else []
    if json:
        measured = {"profile": profile_object(events)} if profile else {}
        say(jsonlib.dumps({**_object(directory, found), **measured}, allow_nan=False))
        return
    _print(directory, found)
    for line in profile_lines(events) if profile else ():
        say(line)


def _object(directory: Path, found: Brief) -> dict[str, Any]:
    from asia.judge.scoring.outcome import Score
    from asia.ledger.evidence import significance_threshold
    from asia.ledger.run import control, error_of, metric_of, model_to_use

    view, best = found.view, found.view.best
    beside = control(directory, view.started, found.finished)
    error = error_of(directory) if found.state == "interrupted" else None
    named = model_to_use(view)
    return {
        "run": view.started.run,
        "problem": view.started.problem,
        "agent": view.started.agent,
        "legs": [{"agent": leg.agent, "experiments": leg.experiments} for leg in view.started.legs],
        "handed_over": [
            {"agent": e.agent, "after": e.after, "reason": e.reason} for e in view.handed_over
        ],
        "seed": view.started.seed,
        "state": found.state,
        "stopped": view.stopped.reason if view.stopped else None,
        "usage": asdict(view.usage) if view.usage else None,
        "experiments": found.finished,
        "budget": view.budget,
        "isolation": view.started.isolation,
        "isolation_strict": view.started.isolation_strict,
        **_engine_object(view),
        "running": [e.number for e in view.running] if found.state == "running" else [],
        "metric": metric_of(directory),
        "early_stopping": view.started.early_stopping,
        "residuals": view.started.residuals,
        "validation_scores": found.validation_scores,
        "best": {"experiment": best.number, "V": best.score.value} if best and best.score else None,
        "incumbent": view.incumbent.number if view.incumbent else None,
        "remark": _remark(view) or None,
        "error": error,
        "failed_checks": list(view.failed_checks),
        "floor": significance_threshold(view),
        "use": named.model if named else None,
        "use_reason": named.reason if named else None,
        "confirmed": None if view.confirmed is None else asdict(view.confirmed),
        "validated": [asdict(one) for one in view.validated],
        "control": None
        if beside is None
        else {"run": beside.run, "V": beside.value, "experiments": beside.experiments},
        "rungs": {
            r.name: r.outcome.value if isinstance(r.outcome, Score) else None for r in view.rungs
        },
    }


def _engine_object(view: SearchView) -> dict[str, Any]:
    """Return the settings of the evaluation."""
    from asia.ledger.evidence import cancelled_folds, pruned_folds

    return {
        "parallel": view.started.parallel,
        "device": view.started.device,
        "stop_folds": view.started.stop_folds,
        "pruned_folds": sum(pruned_folds(view)),
        "cancelled_folds": cancelled_folds(view),
    }


def _state_words(found: Brief) -> str:
    """Return the state; `waiting for a candidate` for an idle search of a workspace or server."""
    view = found.view
    outside = view.started.agent in ("workspace", "mcp")
    idle = bool(view.experiments) and view.pending is None and found.finished < view.budget
    if found.state == "running" and outside and idle:
        return "waiting for a candidate"
    return found.state


def _print(directory: Path, found: Brief) -> None:
    from asia._timer import duration
    from asia.interfaces.cli.text import (
        experiment_line,
        stop_words,
        usage_words,
        validation_words,
        value_words,
    )
    from asia.ledger.run import control, error_of, metric_of
    from asia.ledger.text import control_text
    from asia.problem.metrics import metric_label

    view = found.view
    beside = control(directory, view.started, found.finished)
    say(
        f"run {view.started.run}  problem {view.started.problem}  agent {view.started.agent}  "
        f"seed {view.started.seed}  isolation {view.started.isolation_words}"
    )
    say(
        f"{_state_words(found)}: {found.finished} of {view.budget} experiments in "
        f"{duration(found.seconds)}, metric {metric_label(metric_of(directory))}"
    )
    error = error_of(directory) if found.state == "interrupted" else None
    if error is not None:
        say(f"error   {error}")
    _print_course(view, running=found.state == "running")
    if view.stopped is not None:
        words = stop_words(view.stopped.reason, view)
        say(f"stopped: {words}" + (f" ({view.stopped.detail})" if view.stopped.detail else ""))
    if remark := _remark(view):
        say(f"remark  {remark}")
    if view.usage is not None:
        say(f"agent   {usage_words(view.usage)}")
    if view.started.early_stopping == "validation":
        say(f"V is {validation_words(found.validation_scores)}")
    if view.started.residuals == "held_out":
        say("V is with held-out residuals shown")
    _print_winner(view)
    for line in view.failed_checks:
        say(f"note    {line}")
    if view.unsealed is not None:
        say(f"the test was opened: asia unseal {directory.name} prints the result")
    if beside is not None:
        say(f"control {control_text(beside, view.started)}")
    for rung in view.rungs:
        say(f"reference {rung.name:<18} V={value_words(rung.outcome)}")
    shown = view.finished[-LAST:]
    if shown:
        say("min fit: over folds and outputs the least 100 (1 - |y - y_hat| / |y - mean of y|) %")
    if found.finished > len(shown):
        say(f"the last {len(shown)} of {found.finished} experiments; all are in results.tsv")
    for experiment in shown:
        say(experiment_line(experiment, view))


def _remark(view: SearchView) -> str:
    """Return the last remark of the agent."""
    return view.experiments[-1].proposed.remark if view.experiments else ""


def _print_course(view: SearchView, *, running: bool) -> None:
    """Print the experiments in flight, pruned folds and hand-overs."""
    from asia.interfaces.cli.text import running_words
    from asia.ledger.evidence import cancelled_folds, pruned_folds
    from asia.ledger.text import hand_over_text

    for words in running_words(view) if running else ():
        say(f"running {words}")
    if view.started.stop_folds:
        left = pruned_folds(view)
        ended = cancelled_folds(view)
        ran = f", {ended} of them ended while they ran" if ended else ""
        say(f"folds   {sum(left)} passed over{ran}, in {len(left)} experiments far behind the best")
    for event in view.handed_over:
        say(f"relay   {hand_over_text(event)}")


def _print_winner(view: SearchView) -> None:
    """Print the evidence for the best candidate other than V."""
    from asia.interfaces.cli.text import again_words, guard_words, use_lines
    from asia.ledger.text import floor_words, method_note, validation_summary

    if words := method_note(view):
        say(f"method  {words}")
    if words := floor_words(view):
        say(f"floor   {words}")
    if words := again_words(view):
        say(f"again   {words}")
    for line in use_lines(view):
        say(line)
    if view.looks:
        say(f"guard   {guard_words(view)}")
    if view.confirmed is not None:
        from asia.interfaces.cli.results import noise_words, verdict

        say(f"confirm {verdict(view.confirmed)}; noise floor {noise_words(view.confirmed)}")
    for dossier in view.validated:
        say(f"valid   {validation_summary(dossier)}")
