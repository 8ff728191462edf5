"""Display of a running search or a waiting submission."""

from __future__ import annotations

import json as jsonlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.status import Status as Spinner
from rich.text import Text

from asia import __version__
from asia._text import printable_line, say
from asia._timer import TimeSpent, duration
from asia.interfaces.cli.options import DEFAULT_RUNS
from asia.interfaces.cli.text import (
    NOT_LEAK_FREE,
    RESIDUALS_SHOWN,
    Terminal,
    again_words,
    event_object,
    experiment_line,
    guard_words,
    last_line,
    profile_lines,
    profile_object,
    running_words,
    stop_words,
    usage_words,
    use_lines,
    validation_words,
    value_words,
)
from asia.judge.evaluation.references import TRUTH
from asia.judge.scoring.outcome import Failure
from asia.ledger.events import (
    Evaluated,
    Event,
    Extended,
    HandedOver,
    Proposed,
    Refitted,
    RungScored,
)
from asia.ledger.evidence import identified, significance_threshold
from asia.ledger.run import control, open_run
from asia.ledger.text import (
    control_text,
    error_value,
    floor_words,
    hand_over_text,
    identified_lines,
    method_note,
    seed_mean_words,
)
from asia.ledger.view import SearchView
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.search.run import Prepared, environment_changes

if TYPE_CHECKING:
    from asia.interfaces.workspace.server import Desk, ExperimentSummary, SearchProgress, Submission


# Output of a running search: one line per experiment, a live footer on a terminal.


# More parameters than these are left to `asia show`.
_MOST_PARAMETERS = 12

STYLES = {
    "keep": "bold green",
    "discard": "dim",
    "inconclusive": "cyan",
    "crash": "red",
    "timeout": "yellow",
}


def make_display(problem: Problem, prepared: Prepared, *, json: bool) -> JsonDisplay | TextDisplay:
    """Make the display: JSON lines, or text."""
    return JsonDisplay() if json else TextDisplay(problem, prepared)


@dataclass
class JsonDisplay:
    """JSON lines on stdout: `start`, one object per event, `done`."""

    def on_start(self, view: SearchView) -> None:
        """Print `start`."""
        start = view.started
        _print_json(
            {
                "event": "start",
                "run": start.run,
                "problem": start.problem,
                "early_stopping": start.early_stopping,
                "residuals": start.residuals,
            }
        )

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print the event."""
        _print_json(event_object(event, view))

    def finish(
        self, view: SearchView, pictures: Sequence[Path], failed: Sequence[str] = ()
    ) -> None:
        """Print `done`."""
        best = view.best
        _print_json(
            {
                "event": "done",
                "run": view.started.run,
                "experiments": len(view.finished),
                "best": None
                if best is None or best.score is None
                else {"experiment": best.number, "V": best.score.value},
                "early_stopping": view.started.early_stopping,
                "residuals": view.started.residuals,
                "validation_scores": view.validation_scores,
                "pictures": [str(p) for p in pictures],
                "failed_checks": [*view.failed_checks, *failed],
            }
        )

    def profile(self, directory: Path, beside: Sequence[TimeSpent]) -> None:
        """Print `profile`. beside: seconds that the ledger does not record."""
        _print_json({"event": "profile", **profile_object(_events(directory), beside)})

    def close(self) -> None:
        """Do nothing."""


@dataclass
class TextDisplay:
    """Text lines; a live footer if stdout is a terminal."""

    problem: Problem
    prepared: Prepared
    console: Terminal = field(default_factory=lambda: Terminal(soft_wrap=True))
    footer: Spinner | None = None

    def on_start(self, view: SearchView) -> None:
        """Print the problem, the isolation, and the experiments that the run has already."""
        start, problem = view.started, self.problem
        samples = sum(len(r) for r in problem.train)
        self._print(
            f"ASIA {__version__}  run {start.run}  problem {problem.name}  "
            f"u:{len(problem.inputs)} y:{len(problem.outputs)}  N={samples}  "
            f"Ts={problem.sampling_time:g} s  isolation {start.isolation_words}"
        )
        sealed = f"sealed sha256:{start.test_digest[:8]}" if start.test_digest else "none"
        at_once = f"{start.parallel} in flight  " if start.parallel > 1 else ""
        folds = problem.protocol.folds.count
        self._print(
            f"agent {start.agent}  seed {start.seed}  {at_once}{folds} folds  "
            f"{view.v_name} = {find_metric(problem.protocol.metric).summary}  "
            f"test {sealed}"
        )
        if start.early_stopping == "validation":
            self._print(f"note    {NOT_LEAK_FREE}")
        if start.residuals == "held_out":
            self._print(f"note    {RESIDUALS_SHOWN}")
        for note in start.isolation_notes:
            self._print(f"note    {note}", style="dim")
        for change in environment_changes(start.environment, self.prepared.started.environment):
            self._print(f"note    the run began in another environment: {change}")
        if view.experiments:
            self._print(f"resumed after {len(view.finished)} of {view.budget} experiments")
        for rung in view.rungs:
            self._rung(rung)
        for experiment in view.finished:
            for event in view.handed_over:
                if event.after == experiment.number - 1:
                    self._print(f"relay   {hand_over_text(event)}")
            self._experiment(experiment.number, view)
        if self.console.is_terminal:
            self.footer = self.console.status("")
            self.footer.start()
        self._foot(view)

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print an event if it matters to a user."""
        match event:
            case RungScored():
                self._rung(event)
            case Proposed():
                before = view.experiments[-2].proposed.remark if len(view.experiments) > 1 else ""
                if event.remark and event.remark != before:
                    self._print(f"remark  {event.remark}")
            case Evaluated():
                self._experiment(event.experiment, view)
            case HandedOver():
                self._print(f"relay   {hand_over_text(event)}")
            case Extended():
                self._print(f"extended to {event.experiments} experiments")
            case Refitted():
                for line in event.failed_checks:
                    self._print(f"note    {line}", style="yellow")
                if event.model is None:
                    self._print(f"no refit on all training data: {event.detail}")
            case _:
                pass
        self._foot(view)

    def finish(
        self, view: SearchView, pictures: Sequence[Path], failed: Sequence[str] = ()
    ) -> None:
        """Print the result, the paths of its files, and the next commands."""
        self.close()
        run, best = self._run_word(), view.best
        self._print("")
        if view.stopped is not None:
            self._print(f"stopped  {stop_words(view.stopped.reason, view)}")
            if view.stopped.detail:
                self._print(f"         {view.stopped.detail}")
        if view.usage is not None:
            self._print(f"usage    {usage_words(view.usage)}")
        self._print_best(view)
        self._print_parameters()
        self._print(f"files    {self.prepared.directory}/results.tsv, search_journal.md")
        for picture in pictures:
            if picture.suffix == ".png":
                self._print(f"picture  {picture}")
        for line in failed:
            self._print(f"note     {line}", style="yellow")
        for line in use_lines(view):
            word, _, words = line.partition(" ")
            self._print(f"{word:<9}{words.strip()}")
        if view.refitted is not None:
            self._print("models   asia.simulate(run, ...) uses the one named above")
        show, unseal = f"asia show {run}", f"asia unseal {run}"
        width = len(unseal) + 4
        if best is None:
            self._print(f"next     {show:<{width}}why the last candidate failed")
            return
        self._print(f"next     {show:<{width}}the winner: source, folds, evidence")
        if view.started.test_digest and view.unsealed is None:
            self._print(f"         {unseal:<{width}}score it on the sealed test, once")

    def _print_parameters(self) -> None:
        """Print the parameters of the winner with their intervals, if they are few."""
        found = identified(open_run(self.prepared.directory))
        if found is not None and 0 < len(found.parameters) <= _MOST_PARAMETERS:
            for line in identified_lines(found, equations=False):
                self._print(printable_line(line))

    def _print_best(self, view: SearchView) -> None:
        """Print the winner and the evidence for its quality."""
        best = view.best
        if best is None or best.score is None:
            self._print("best     none: every candidate failed")
            return
        folds = ", ".join(error_value(f.value) for f in best.score.folds)
        mean = f", {words}" if (words := seed_mean_words(best)) else ""
        self._print(
            f"best     #{best.number:02d} V={error_value(best.score.value)} (folds {folds}){mean}  "
            f"{best.proposed.title}",
            style="bold",
        )
        if view.started.early_stopping == "validation":
            self._print(f"V is     {validation_words(view.validation_scores)}")
        if view.started.residuals == "held_out":
            self._print("V is     with held-out residuals shown")
        beside = control(self.prepared.directory, view.started, len(view.finished))
        if beside is not None:
            self._print(f"control  {control_text(beside, view.started)}")
        for name, words in (
            ("method", method_note(view)),
            ("floor", floor_words(view)),
            ("again", again_words(view)),
        ):
            if words:
                self._print(f"{name:<8} {words}")
        if view.looks:
            self._print(f"guard    {guard_words(view)}")
        rungs = " · ".join(f"{r.name} {value_words(r.outcome)}" for r in view.rungs)
        self._print(f"references {rungs}")

    def profile(self, directory: Path, beside: Sequence[TimeSpent]) -> None:
        """Print the time of each activity. beside: seconds that the ledger does not record."""
        for line in profile_lines(_events(directory), beside):
            self._print(line)

    def close(self) -> None:
        """Stop the footer."""
        if self.footer is not None:
            self.footer.stop()

    def _run_word(self) -> str:
        """Return the RUN argument of this run: its name, or its path outside the default folder."""
        directory = self.prepared.directory
        return directory.name if directory.parent == DEFAULT_RUNS else str(directory)

    def _experiment(self, number: int, view: SearchView) -> None:
        experiment = view.experiment(number)
        assert experiment.result is not None
        status = experiment.result.status
        self._print(experiment_line(experiment, view), style=STYLES.get(status, "magenta"))
        if experiment.failure is not None:
            self._print(f"    {last_line(experiment.failure)}", style="dim")
        for line in experiment.result.failed_checks:
            self._print(f"    {line}", style="yellow")

    def _rung(self, rung: RungScored) -> None:
        note = "   the noise floor" if rung.name == TRUTH else ""
        self._print(f"reference {rung.name:<18} V={value_words(rung.outcome)}{note}", style="cyan")
        if isinstance(rung.outcome, Failure):
            self._print(f"        {last_line(rung.outcome)}", style="dim")

    def _foot(self, view: SearchView) -> None:
        if self.footer is None:
            return
        doing = "scoring the rungs"
        if view.stopped is not None:
            doing = "refitting the winner on all training data"
        elif view.running:
            doing = " · ".join(running_words(view))
        done = f"{len(view.finished)}/{view.budget} experiments · {duration(view.seconds)}"
        floor = significance_threshold(view)
        if floor is not None:
            done += f" · floor {floor:.2g}"
        self.footer.update(Text(f"{done} · {printable_line(doing)}"))

    def _print(self, text: str, style: str = "") -> None:
        self.console.print(printable_line(text), style=style)
        if not self.console.is_terminal:
            sys.stdout.flush()


def _events(directory: Path) -> list[Event]:
    return [line.event for line in open_run(directory).lines]


def _print_json(value: dict[str, Any]) -> None:
    say(jsonlib.dumps(value, allow_nan=False), flush=True)


# Progress lines while a candidate waits for its result.


_AGAIN_SECONDS = 60.0


class Waiting:
    """Print each change once: finished rungs and experiments, and the state of the submission.
    Repeat an unchanged state every minute."""

    def __init__(self, desk: Desk, say: Callable[[str], None]) -> None:
        self._desk, self._say = desk, say
        now = desk.progress()
        self._rungs = set(now.rungs if now.experiments else ())
        self._finished = now.experiments
        self._line = ""
        self._since = self._said = time.monotonic()

    def look(self, submission: Submission) -> None:
        """Print the changes since the last call."""
        now = self._desk.progress()
        for name, value in now.rungs.items():
            if name not in self._rungs:
                self._rungs.add(name)
                self._say(f"reference {name}: {now.v_name} {_value(value)}")
        if now.experiments > self._finished:
            for result in self._desk.results()[self._finished :]:
                if result.experiment != submission.experiment:
                    self._say(finished_line(result, now))
            self._finished = now.experiments
        self._say_where(_where(submission, now))

    def _say_where(self, line: str) -> None:
        clock = time.monotonic()
        if line != self._line:
            self._line, self._since, self._said = line, clock, clock
            if line:
                self._say(line)
        elif line and clock - self._said >= _AGAIN_SECONDS:
            self._said = clock
            self._say(f"{line}, for {duration(clock - self._since)}")


def finished_line(result: ExperimentSummary, now: SearchProgress) -> str:
    """`#01 keep    V = 0.7984 in 12s: baseline`"""
    head = f"#{result.experiment:02d} {result.status:<7} {now.v_name}"
    return f"{head} {_value(result.value)} in {duration(result.seconds)}: {result.title}"


def _value(value: float | None) -> str:
    from asia.ledger.text import error_value

    return "none" if value is None else f"= {error_value(value)}"


def _where(submission: Submission, now: SearchProgress) -> str:
    running = now.running if submission.state == "queued" else submission.experiment
    if submission.state not in ("queued", "running"):
        return ""
    if running is not None:
        what = ", the baseline," if running == 1 else ""
        return f"#{running:02d}{what} is being evaluated{_behind(submission)}"
    if now.experiments == 0:
        return "the search evaluates the rungs, which are simple references, then the baseline"
    return f"queued, {submission.ahead} before it" if submission.ahead else "queued, it is next"


def _behind(submission: Submission) -> str:
    if submission.state != "queued":
        return ""
    return f"; {submission.ahead} before yours" if submission.ahead else "; yours is next"
