"""asia run: search."""

from __future__ import annotations

import json as jsonlib
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.status import Status as Spinner
from rich.text import Text

from asia import __version__
from asia._diagnostic import diagnostic
from asia._progress import now_doing
from asia._text import printable_line, say
from asia._timer import Activity, ActivityTimer, TimeSpent, duration
from asia.errors import UserError
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    PREFIX,
    CommandOptions,
    EngineOptions,
    GuardRecords,
    Json,
    LlmOptions,
    ModelOptions,
    ProblemName,
    Profile,
    Runs,
    SearchOptions,
    access_settings,
    given,
    jail_words,
)
from asia.interfaces.cli.output import (
    Terminal,
    fact_line,
    print_alarms,
    profile_lines,
    profile_object,
    running_words,
    search_facts,
    verdict_object,
)
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.events import (
    Evaluated,
    Event,
    Extended,
    GuardLooked,
    Proposed,
    ReferenceScored,
    Refitted,
)
from asia.ledger.evidence import identified, incumbent_threshold
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.presentation.experiments import (
    error_line,
    experiment_line,
    reference_note,
    references_text,
    value_text,
)
from asia.presentation.integrity import v_notes
from asia.presentation.parameters import identified_blocks
from asia.presentation.table import block_lines
from asia.problem.metrics import find_metric

if TYPE_CHECKING:
    from asia.agents.view import Agent
    from asia.problem.problem import Problem
    from asia.search.run import Prepared

NOTHING_FOUND = 3
BRIEF_HELP = frozenset(
    {"problem", "agent", "experiments", "seed", "hours", "name", "runs", "parallel", "executor"}
    | {"isolation", "model", "json"}
)


def run(
    *,
    problem: ProblemName = "two_tanks_sim",
    agent: Annotated[
        str,
        typer.Option(
            help="Agent: expert, random, bayes, llm, command:NAME, or your module:Class. "
            "command:NAME*3,expert: several at once."
        ),
    ] = "expert",
    options: SearchOptions,
    engine: EngineOptions,
    sink: Annotated[
        list[str] | None,
        typer.Option(
            help="Send the search to mlflow, trackio, an installed sink or module:Name; repeatable."
        ),
    ] = None,
    guard: GuardRecords = None,
    runs: Runs = DEFAULT_RUNS,
    profile: Profile = False,
    json: Json = False,
    models: ModelOptions,
    llm: LlmOptions,
    command: CommandOptions,
) -> None:
    """Search for a model. Repeat the command to resume; more --experiments extends the search.

    Exit code 3: the search is finished and no candidate has a score.
    """

    from asia.problem.load import load_problem
    from asia.search.run import guard_share

    options.check()
    driver = make_driver(agent, models, llm, command)
    timer = ActivityTimer()
    with timer.activity(Activity.PREPARE):
        loaded = options.applied(load_problem(problem, guard_share(driver.name, guard)))
    search_and_print(
        loaded, driver, options, engine, runs, sink=sink, json=json, profile=profile, timer=timer
    )


def search_and_print(
    loaded: Problem,
    driver: Driver,
    options: SearchOptions,
    engine: EngineOptions,
    runs: Path,
    *,
    sink: Sequence[str] | None = None,
    json: bool = False,
    profile: bool = False,
    timer: ActivityTimer,
) -> None:
    """Search a problem with an agent, print events and results; the exit code as for `run`."""
    from asia.agents.leading import LeadingAgent
    from asia.interfaces.coding_agents.session import CommandAgent, search_with_process
    from asia.judge.executors import make_executor
    from asia.report.files import write_report
    from asia.search.run import prepare, search
    from asia.search.sinks import open_sinks

    with timer.activity(Activity.PREPARE):
        ready = prepare(
            loaded,
            driver.name,
            seed=options.seed,
            runs=runs,
            name=options.name,
            isolation=options.level,
            isolation_strict=options.isolation_strict,
            agent_settings=driver.settings,
            parallel=engine.parallel,
        )
        executor = make_executor(engine.executor)
    sinks = open_sinks(ready.directory, sink or ())
    display = JsonDisplay() if json else TextDisplay(loaded, ready)
    with closing(display), sinks:
        for line in driver.notes:
            say(line, file=sys.stderr)
        agent = driver.make(ready)
        process = agent.following if isinstance(agent, LeadingAgent) else agent
        on_event = sinks.after_event(display.on_event)
        on_start = sinks.after_start(display.on_start)
        if isinstance(process, CommandAgent):
            view = search_with_process(ready, agent, process, on_event, on_start, executor)
        else:
            view = search(ready, agent, on_event, on_start, executor)
        failed: list[str] = []
        pictures: tuple[Path, ...] = ()
        with timer.activity(Activity.PICTURES), diagnostic("pictures", failed):
            pictures = write_report(ready.directory, failed=failed)
        display.finish(view, pictures, failed)
        if profile:
            events = [line.event for line in open_run(ready.directory).lines]
            display.profile(events, timer.only(Activity.PREPARE, Activity.PICTURES))
    if view.best is None:
        raise typer.Exit(NOTHING_FOUND)


# Agents as the command starts them.


_MOST_CODING_AGENTS = 16


@dataclass(frozen=True)
class Driver:
    """Name, factory and settings of an agent."""

    name: str
    """The agent's name, part of the run's name."""
    make: Callable[[Prepared], Agent]
    """Makes the agent for a search."""
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """Settings of the agent that the ledger records; no keys."""
    notes: tuple[str, ...] = ()
    """Lines that are printed before the search."""


def make_driver(
    agent: str, models: ModelOptions, llm: LlmOptions, command: CommandOptions
) -> Driver:
    """Make the driver of an agent. Raises UserError for an option of another agent."""
    from asia.agents.registry import choose_agent
    from asia.interfaces.coding_agents.presets import PRESETS

    commands = any(part.startswith(PREFIX) for part in agent.split(","))
    kind = "command" if commands else agent
    for owners, options in (
        (("llm",), given(llm, leave_out=("base_url", "api_key_env"))),
        (("command",), given(command, leave_out=("stuck_minutes",))),
        (("llm", "command"), given(models)),
    ):
        whose = " or ".join("command:NAME" if owner == "command" else owner for owner in owners)
        for name in options:
            if kind not in owners:
                raise UserError(
                    f"--{name.replace('_', '-')} is for --agent {whose}, and the agent is "
                    f"'{agent}': leave it out"
                )

    if commands:
        return command_driver(agent, command, models)
    if agent == "llm":
        model = llm.agent(models)
        return Driver(model.name, lambda ready: model, model.recorded())
    if agent in PRESETS:
        raise UserError(f"--agent {agent}: write command:{agent}, as for every coding agent")
    chosen = choose_agent(agent)
    return Driver(chosen.agent.name, lambda ready: chosen.agent, dict(chosen.settings))


def command_driver(agent: str, options: CommandOptions, limits: ModelOptions) -> Driver:
    """Make the driver of `command:NAME*N,expert`: program, rules and jail. Raises UserError for
    another text, a missing program, and a limit that cannot be enforced."""
    from asia.agents.registry import COMPANION, RESERVED, make_agent
    from asia.interfaces.coding_agents.presets import make_preset
    from asia.interfaces.coding_agents.session import CommandRules, check_rules, command_agent
    from asia.judge.sandbox.jail import Jail

    coding, *others = sorted(agent.split(","), key=lambda part: not part.startswith(PREFIX))
    name, times, digits = coding.removeprefix(PREFIX).partition("*")
    if not name.replace("-", "").isalnum():
        raise UserError(f"--agent {agent}: expected command:NAME with letters and digits")
    count = int(digits) if re.fullmatch(r"[0-9]{1,3}", digits) else int(not times)
    if not 1 <= count <= _MOST_CODING_AGENTS:
        raise UserError(
            f"--agent {agent}: expected command:NAME*N with N from 1 to {_MOST_CODING_AGENTS}"
        )
    if others not in ([], ["expert"]):
        raise UserError(
            f"--agent {agent}: expected one command:NAME*N, and beside it expert or nothing"
        )
    if name in RESERVED:
        raise UserError(f"--agent {agent}: '{name}' is reserved; choose another name")
    preset = make_preset(name, options.command)
    access = options.access(preset.keys)
    rules = CommandRules(
        minutes=options.agent_minutes,
        tokens=limits.max_tokens,
        cost=limits.max_cost,
        stuck_minutes=options.stuck_minutes,
        **vars(access),
        jail=Jail.why_not() is None,
        model=limits.model,
    )
    check_rules(preset, rules)
    isolation = jail_words(rules)
    if not rules.jail:
        isolation = (
            "no jail (level process). It can read all your files: other runs, "
            "unsealed test files, keys. Its score still comes only from the evaluator. "
            "Install bubblewrap for a jail."
        )
    settings = {
        "command": options.command or name,
        "model": rules.model or "its default",
        "jail": "namespace" if rules.jail else "none",
        **access_settings(rules),
    }
    names, label = (name,) if others else ("",), name
    if count > 1:
        names, label = tuple(f"{name}-{k}" for k in range(1, count + 1)), f"{name}-x{count}"
        settings["agents"] = str(count)
    if others:
        label, settings[COMPANION] = f"{label}+{others[0]}", others[0]
    companion = make_agent(others[0]) if others else None
    return Driver(
        label,
        lambda ready: command_agent(ready, preset, rules, names, companion),
        settings,
        (f"agent {label}: {isolation}",),
    )


# Output of a running search: one line per experiment, a live footer on a terminal.


_STYLES = {
    "keep": "bold green",
    "discard": "dim",
    "inconclusive": "cyan",
    "mixed": "cyan",
    "unconfirmed": "yellow",
    "crash": "red",
    "timeout": "yellow",
}


class JsonDisplay:
    """JSON lines on stdout: `start`, one object per event, `done`."""

    def on_start(self, view: SearchView) -> None:
        """Print `start`."""
        start = view.started
        self._print(
            "start",
            run=start.run,
            problem=start.problem,
            early_stopping=start.early_stopping,
            residuals=start.residuals,
        )

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print the event as a flat object."""
        match event:
            case Evaluated():
                best, experiment = view.best, view.experiment(event.experiment)
                self._print(
                    "evaluated",
                    experiment=event.experiment,
                    status=event.status,
                    V=experiment.value,
                    reason=experiment.failure.reason.value if experiment.failure else None,
                    title=experiment.proposed.title,
                    seconds=round(event.seconds, 3),
                    validation_scores=event.validation_scores,
                    retests=[r.value for r in event.retests],
                    threshold=event.threshold,
                    failed_checks=list(event.failed_checks),
                    best=best.number if best else None,
                )
            case ReferenceScored():
                self._print(
                    "reference", name=event.name, V=_value(event.outcome), structure=event.structure
                )
            case GuardLooked():
                scores = {str(s.experiment): _value(s.outcome) for s in event.scores}
                self._print("guard", look=event.look, pick=event.pick, V=scores)
            case Refitted():
                again: dict[str, Any] = {}
                if event.again is not None:
                    again = {"again_fold": event.again.fold, "again_ratio": event.again.value}
                self._print("refitted", experiment=event.experiment, use=event.use, **again)
            case _:
                self._print(event.event)

    def finish(self, view: SearchView, pictures: Sequence[Path], failed: Sequence[str]) -> None:
        """Print `done`."""
        best = view.best
        self._print(
            "done",
            run=view.started.run,
            experiments=len(view.finished),
            best=None
            if best is None or best.score is None
            else {"experiment": best.number, "V": best.score.value},
            early_stopping=view.started.early_stopping,
            residuals=view.started.residuals,
            validation_scores=view.validation_scores,
            pictures=[str(p) for p in pictures],
            failed_checks=[*view.failed_checks, *failed],
            verdict=verdict_object(view),
        )

    def profile(self, events: Sequence[Event], unrecorded: Sequence[TimeSpent]) -> None:
        """Print `profile`. unrecorded: seconds that the ledger does not record."""
        self._print("profile", **profile_object(events, unrecorded))

    def close(self) -> None:
        """Do nothing."""

    def _print(self, event: str, **values: Any) -> None:
        say(jsonlib.dumps({"event": event, **values}, allow_nan=False), flush=True)


def _value(outcome: Score | Failure) -> float | None:
    return outcome.value if isinstance(outcome, Score) else None


@dataclass
class TextDisplay:
    """Text lines; a live footer if stdout is a terminal."""

    problem: Problem
    prepared: Prepared
    console: Terminal = field(default_factory=lambda: Terminal(soft_wrap=True))
    footer: Spinner | None = None

    def on_start(self, view: SearchView) -> None:
        """Print the problem, the isolation, and the experiments that the run has already."""
        from asia.search.run import environment_changes

        start, problem = view.started, self.problem
        samples = sum(len(r) for r in problem.train)
        self._print(
            f"ASIA {__version__}  run {start.run}  problem {problem.name}  "
            f"inputs {len(problem.inputs)}  outputs {len(problem.outputs)}  samples {samples}  "
            f"sampling time {problem.sampling_time:g} s  isolation {start.isolation_words}"
        )
        sealed = f"sealed sha256:{start.test_digest[:8]}" if start.test_digest else "none"
        at_once = f"{start.parallel} parallel experiments  " if start.parallel > 1 else ""
        folds, metric = problem.protocol.folds.count, find_metric(problem.protocol.metric)
        judged = metric.summary
        if problem.control is not None:
            judged = f"{metric.label} of the closed loop, in tolerances"
        self._print(
            f"agent {start.agent}  seed {start.seed}  {at_once}{folds} folds  "
            f"{view.v_name} = {judged}  test {sealed}"
        )
        for words in v_notes(view):
            self._print(f"note    V is {words}")
        if problem.guard_names:
            names = ", ".join(problem.guard_names)
            self._print(f"guard   {names}, shown to no candidate and no agent")
        for note in start.isolation_notes:
            self._print(f"note    {note}", style="dim")
        for change in environment_changes(start.environment, self.prepared.started.environment):
            self._print(f"note    the run began in another environment: {change}")
        if view.experiments:
            self._print(f"resumed after {len(view.finished)} of {view.budget} experiments")
        for reference in view.references:
            self._print_reference(reference)
        for experiment in view.finished:
            self._print_experiment(experiment.number, view)
        if self.console.is_terminal:
            self.footer = self.console.status("")
            self.footer.start()
        self._update_footer(view)

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print an event if it matters to a user."""
        match event:
            case ReferenceScored():
                self._print_reference(event)
            case Proposed():
                before = view.experiments[-2].proposed.remark if len(view.experiments) > 1 else ""
                if event.remark and event.remark != before:
                    self._print(f"remark  {event.remark}")
            case Evaluated():
                self._print_experiment(event.experiment, view)
            case Extended():
                self._print(f"extended to {event.experiments} experiments")
            case Refitted():
                for line in event.failed_checks:
                    self._print(f"note    {line}", style="yellow")
                if event.model is None:
                    self._print(f"no refit on all training data: {event.detail}")
            case _:
                pass
        self._update_footer(view)

    def finish(self, view: SearchView, pictures: Sequence[Path], failed: Sequence[str]) -> None:
        """Print the result, the paths of its files, and the next commands."""
        self.close()
        directory, best = self.prepared.directory, view.best
        self._print("")
        print_alarms(view)
        for label, text in search_facts(view, directory, len(view.finished)):
            self._print(fact_line(label, text), style="bold" if label == "best" else "")
        self._print(f"references V: {references_text(view)}")
        # More than a dozen parameters are left to `asia show`.
        model = identified(open_run(directory))
        if model is not None and 0 < len(model.parameters) <= 12:
            for line in block_lines(identified_blocks(model, equations=False)):
                self._print(line)
        self._print(f"files    {directory}/results.tsv, search_journal.md")
        for picture in pictures:
            if picture.suffix == ".png":
                self._print(f"picture  {picture}")
        for line in failed:
            self._print(f"note     {line}", style="yellow")
        if view.refitted is not None and self.problem.control is None:
            self._print("models   asia.simulate(run, ...) uses the model of the line `use`")
        run = directory.name if directory.parent == DEFAULT_RUNS else str(directory)
        show, validate, report, linear, unseal = (
            f"asia {name} {run}" for name in ("show", "validate", "report", "linear", "unseal")
        )
        width = len(validate) + 4
        if best is None:
            self._print(f"next     {show:<{width}}why the last candidate failed")
            return
        self._print(f"next     {show:<{width}}the best candidate: source, folds, evidence")
        self._print(f"         {validate:<{width}}may I use this model: checks of the residuals")
        self._print(f"         {report:<{width}}one HTML page about the search")
        if self.problem.control is None:
            self._print(f"         {linear:<{width}}order, poles, gain, Bode plot of the model")
        if view.started.test_digest and view.unsealed is None:
            self._print(f"         {unseal:<{width}}score it on the sealed test, once")

    def profile(self, events: Sequence[Event], unrecorded: Sequence[TimeSpent]) -> None:
        """Print the time of each activity. unrecorded: seconds that the ledger does not record."""
        for line in profile_lines(events, unrecorded):
            self._print(line)

    def close(self) -> None:
        """Stop the footer."""
        if self.footer is not None:
            self.footer.stop()

    def _print_experiment(self, number: int, view: SearchView) -> None:
        experiment = view.experiment(number)
        assert experiment.result is not None
        style = _STYLES.get(experiment.result.status, "magenta")
        self._print(experiment_line(experiment, view), style=style)
        if experiment.failure is not None:
            self._print(f"    {_failure(experiment.failure)}", style="dim")
        mean = view.reference_value("training mean")
        worse = mean is not None and experiment.score and experiment.score.value > mean
        if worse and experiment.kept:
            text = "    kept as the first with a score, although the training mean has a lower V"
            self._print(text, style="yellow")
        for line in experiment.result.failed_checks:
            self._print(f"    {line}", style="yellow")

    def _print_reference(self, reference: ReferenceScored) -> None:
        text = f"V={value_text(reference.outcome)}   {reference_note(reference)}"
        self._print(f"reference {reference.name:<18} {text.rstrip()}", style="cyan")
        if isinstance(reference.outcome, Failure):
            self._print(f"        {_failure(reference.outcome)}", style="dim")

    def _update_footer(self, view: SearchView) -> None:
        doing = "scoring the reference models"
        if view.stopped is not None:
            doing = "refitting the best candidate on all training data"
        elif view.running:
            doing = " · ".join(running_words(view))
        done = f"{len(view.finished)}/{view.budget} experiments · {duration(view.seconds)}"
        threshold = incumbent_threshold(view)
        if threshold is not None:
            done += f" · threshold {threshold:.2g}"
        text = f"{done} · {printable_line(doing)}"
        if self.footer is None:
            now_doing(text)
        else:
            self.footer.update(Text(text))

    def _print(self, text: str, style: str = "") -> None:
        self.console.print(printable_line(text), style=style)
        if not self.console.is_terminal:
            sys.stdout.flush()


def _failure(failure: Failure) -> str:
    """The last line of a failure, or its advice."""
    return error_line(failure.detail, 160) or failure.advice
