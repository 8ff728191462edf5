"""asia status: the progress of a run."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Json, Profile, RunName, Runs

if TYPE_CHECKING:
    from asia.ledger import Brief, SearchView

LAST = 50


def status(
    run: RunName = None, runs: Runs = DEFAULT_RUNS, profile: Profile = False, json: Json = False
) -> None:
    """Print the progress of a run: state, experiments, best candidate so far."""
    from asia.cli._output.profile import profile_lines, profile_object
    from asia.ledger import brief, open_run

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
    from asia.ledger import control, error_of, floor_to_beat, metric_of, model_to_use
    from asia.scoring import Score

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
        "floor": floor_to_beat(view),
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
    from asia.ledger import folds_ended, folds_passed_over

    return {
        "parallel": view.started.parallel,
        "device": view.started.device,
        "stop_folds": view.started.stop_folds,
        "folds_passed_over": sum(folds_passed_over(view)),
        "folds_ended": folds_ended(view),
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
    from asia.cli._output.words import (
        duration,
        experiment_line,
        stop_words,
        usage_words,
        validation_words,
        value_words,
    )
    from asia.ledger import control, control_words, error_of, metric_of
    from asia.protocol import metric_label

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
        say(f"control {control_words(beside, view.started)}")
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
    from asia.cli._output.words import running_words
    from asia.ledger import folds_ended, folds_passed_over, hand_over_words

    for words in running_words(view) if running else ():
        say(f"running {words}")
    if view.started.stop_folds:
        left = folds_passed_over(view)
        ended = folds_ended(view)
        ran = f", {ended} of them ended while they ran" if ended else ""
        say(f"folds   {sum(left)} passed over{ran}, in {len(left)} experiments far behind the best")
    for event in view.handed_over:
        say(f"relay   {hand_over_words(event)}")


def _print_winner(view: SearchView) -> None:
    """Print the evidence for the best candidate other than V."""
    from asia.cli._output.words import again_words, guard_words, use_lines
    from asia.ledger import dossier_words, floor_words, method_words

    if words := method_words(view):
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
        from asia.cli._output.confirmation import noise_words, verdict

        say(f"confirm {verdict(view.confirmed)}; noise floor {noise_words(view.confirmed)}")
    for dossier in view.validated:
        say(f"valid   {dossier_words(dossier)}")
