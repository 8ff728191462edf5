"""A coding agent that drives a search: started in a jail, capped, stopped, taken up again."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from asia._text import one_line
from asia.agents import Agent, AgentStoppedError, Journal, Proposal, SubmittedAgent
from asia.drive._desk import RunDesk
from asia.drive._program import Confinement
from asia.drive._queue import Queue
from asia.drive._serve import clear_known, clearing
from asia.drive._socket import DeskServer
from asia.drive._workspace import DESK_VARIABLE, write_folder, write_views
from asia.drive._write_file import write_file
from asia.drive.command.access import check_access, check_program, copied_configs
from asia.drive.command.presets import Preset, filled
from asia.drive.command.rules import (
    CommandRules,
    Secrets,
    Spent,
    StopCause,
    check_rules,
)
from asia.drive.command.session import Session
from asia.drive.command.stream import Stream
from asia.errors import UserError
from asia.executor import Executor
from asia.ledger import (
    Evaluated,
    Event,
    SearchView,
    SessionEnded,
    SessionStarted,
    StopReason,
    Store,
    Streamed,
    Usage,
    read_lines,
)
from asia.sandbox import INSIDE, SOCKET_FOLDER, Jail, jail_environment
from asia.search._loop import OnEvent
from asia.search._run import Prepared, search
from asia.search._steering import Steering

SOCKET = "desk.sock"
WORKSPACES = ".workspaces"
_LAST_OUTPUT_SECONDS = 60.0
_IDLE_SESSIONS = 2
_FIRST = (
    "Read PROGRAM.md in this folder and do what it says: find the best model you can, with "
    "`asia try`."
)
_AGAIN = (
    "Continue the search that PROGRAM.md describes: read results.tsv and search_journal.md "
    "first. There are experiments left."
)
_FROM_OTHERS = (
    " Another agent made experiments 1 to {before}: read results.tsv, search_journal.md and the "
    "best candidate first. Yours are those up to number {end}."
)


class CommandAgent(SubmittedAgent):
    """Brings what its process hands in through the socket."""

    def __init__(
        self,
        name: str,
        preset: Preset,
        rules: CommandRules,
        prepared: Prepared,
        folder: Path,
        leg: int = 0,
    ) -> None:
        """leg: its place in a relay, 1-based; its caps count from there."""
        super().__init__(name, self._take, self._watch)
        self._leg = leg
        self._preset, self._folder = preset, folder
        self._directory = prepared.directory
        self._queue = Queue(prepared.directory)
        self._steering = Steering(prepared.directory)
        self._secrets = Secrets.of(rules.variables)
        self._session: Session | None = None
        self._view: SearchView | None = None
        self._finished_before = 0
        self._private = Path(tempfile.mkdtemp(prefix="asia-agent-"))
        self._socket = self._private / "desk"
        self._socket.mkdir()
        configs = copied_configs(rules, self._private / "home") if rules.jail else ()
        self._rules = replace(rules, configs=configs)
        self._server = DeskServer(self._socket / SOCKET, RunDesk(prepared.directory))
        self._quiet_since = self._looked = time.monotonic()
        self._idle = 0
        self._resumable = ""
        self._totals = Usage(cost=0.0)
        self._until: float | None = None

    def attach(self, journal: Journal) -> None:
        """Begin to serve the socket; account for sessions that were cut off."""
        super().attach(journal)
        view = self._view
        assert view is not None
        self._finished_before = len(view.finished)
        minutes = self._rules.minutes
        self._until = None if minutes is None else time.monotonic() + 60 * minutes
        ended = {event.session for event in view.sessions}
        for event in view.begun:
            if event.leg == self._leg and event.session not in ended:
                usage = self._streamed(event.session, journal)
                journal.record(SessionEnded(event.session, "cut off with the search", usage))
        self._server.__enter__()

    def close(self) -> None:
        """End the socket and remove what was private, whatever happened."""
        if self._session is not None:
            self._session.end()
        self._server.__exit__(None, None, None)
        shutil.rmtree(self._private, ignore_errors=True)

    def told(self, event: Event, view: SearchView, store: Store) -> None:
        """An event was written to the ledger: renew the views."""
        self._view = view
        clearing(self._queue, event)
        if isinstance(event, Evaluated):
            self._quiet_since = time.monotonic()
            # An agent that makes its folder unwritable harms only itself.
            with contextlib.suppress(UserError):
                write_views(self._folder, view, store)

    def started(self, view: SearchView, store: Store) -> None:
        """The search begins or goes on."""
        self._view = view
        clear_known(self._queue, view)
        write_views(self._folder, view, store)

    def stopped(self, reason: StopReason) -> None:
        """The search has stopped: where its budget is spent the agent may finish what it says."""
        session = self._session
        if session is None:
            return
        if reason in ("budget", "hours", "saturated"):
            session.wait(_LAST_OUTPUT_SECONDS)
        self._finish(session)

    def leaving(self) -> None:
        """The search is left, by an error or an interrupt where a session still goes on."""
        if self._session is not None:
            self._finish(self._session)

    def _take(self) -> Proposal | None:
        """Return the submitted candidate, unless a cap was reached meanwhile."""
        session = self._session
        stop = session.stopped if session is not None else self._judge(None)
        if stop is not None:
            if session is not None:
                self._finish(session)
            raise AgentStoppedError(*stop)
        proposal = self._queue.take()
        return None if proposal is None else self._secrets.clean_proposal(proposal)

    def _watch(self, seconds: float) -> None:
        """Called while nothing is handed in: start, or start again."""
        del seconds
        session = self._session
        if session is None:
            self._session = self._start()
        elif session.error is not None:
            raise session.error
        elif session.ended:
            self._after(session)

    def _after(self, session: Session) -> None:
        """The process has ended."""
        outcome = self._finish(session)
        view = self._view
        assert view is not None
        stop = session.stopped or Spent.of(view, None, self._leg).over(self._rules)
        if stop is not None:
            raise AgentStoppedError(stop.reason, f"{stop.detail}; last session: {outcome}")
        brought = len(view.experiments) > session.experiments
        self._idle = 0 if brought else self._idle + 1
        if self._idle >= _IDLE_SESSIONS:
            raise AgentStoppedError(
                "agent", f"it ended {self._idle} times without a new experiment, last: {outcome}"
            )

    def _judge(self, stream: Stream | None) -> StopCause | None:
        """Why the agent must stop, from any thread, while something is evaluated too."""
        now, rules, view = time.monotonic(), self._rules, self._view
        assert view is not None
        if view.pending is not None or self._queue.tickets():
            self._quiet_since = now
        elif self._steering.paused:
            self._quiet_since += now - self._looked
        self._looked = now
        over = Spent.of(view, stream, self._leg).over(rules)
        if over is not None:
            return over
        if self._until is not None and now > self._until:
            return StopCause("time", f"{rules.minutes:g} minutes are over")
        if stream is not None and now - self._quiet_since > 60 * rules.stuck_minutes:
            return StopCause("stuck", f"no new experiment in {rules.stuck_minutes:g} minutes")
        last = view.finished[self._finished_before :][-rules.failures :]
        if len(last) == rules.failures and all(e.score is None for e in last):
            return StopCause("stuck", f"{rules.failures} experiments in a row have no score")
        return None

    def _start(self) -> Session:
        preset, rules, view, journal = self._preset, self._rules, self._view, self._journal
        assert view is not None
        assert journal is not None
        number = 1 + max(len(view.begun), len(view.sessions))
        # A jail has a new home each time: only a configuration folder outlives a session.
        kept = not rules.jail or preset.config in [path.name for path in rules.configs]
        resumes = bool(number > 1 and self._resumable and preset.resume and kept)
        template = preset.resume if resumes else preset.start
        notes = "".join(f"\n\nNote of the user: {n.text}" for n in view.notes)
        prompt = self._prompt(number, view) + notes
        write_file(self._folder, "PROMPT.md", prompt)
        spent = Spent.of(view, None, self._leg)
        left = None if rules.cost is None else rules.cost - spent.cost - spent.unknown
        if left is not None and preset.dollars:
            template = (*template, *preset.dollars)
        if rules.model is not None and preset.model:
            template = (*template, *preset.model, rules.model)
        place = INSIDE if rules.jail else str(self._folder)
        values = {
            "prompt": prompt,
            "prompt_file": f"{place}/PROMPT.md",
            "workspace": place,
            "session": self._resumable,
            "dollars": "" if left is None else f"{left:.4f}",
        }
        if not resumes:
            self._totals = Usage(cost=0.0)
        journal.record(SessionStarted(number, left))
        self._quiet_since = self._looked = time.monotonic()
        process = self._spawn(filled(template, values))
        stream = Stream(preset.format, self._totals)
        return Session(process, stream, number, len(view.experiments), self._keep, self._judge)

    def _prompt(self, session: int, view: SearchView) -> str:
        """Return the prompt of the process."""
        own = [event for event in view.begun if event.leg == self._leg]
        if session > 1 and (own or not self._leg):
            return _AGAIN
        before = len(view.finished)
        others = "" if self._leg < 2 else _FROM_OTHERS.format(before=before, end=view.leg_end)
        return _FIRST + others

    def _spawn(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        rules = self._rules
        passed = {n: os.environ[n] for n in rules.variables if n in os.environ}
        if rules.jail:
            jail = Jail(self._folder, self._socket, rules.mounts, rules.configs, rules.network)
            arguments = jail.command(arguments)
            environment = jail_environment(rules.mounts)
            environment[DESK_VARIABLE] = f"{SOCKET_FOLDER}/{SOCKET}"
        else:
            environment = {
                name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ
            } | {DESK_VARIABLE: str(self._socket / SOCKET)}
        try:
            return subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment | passed,
                cwd=self._folder,
                start_new_session=True,
            )
        except OSError as error:
            raise UserError(
                f"the agent could not be started: {arguments[0]}: {error.strerror}; install it, or "
                "give its command line with --command"
            ) from None

    def _keep(self, number: int, data: bytes) -> None:
        journal = self._journal
        assert journal is not None
        journal.record(Streamed(number, journal.put(self._secrets.clean_bytes(data))))

    def _finish(self, session: Session) -> str:
        """End it and write its account; how it ended, in words."""
        journal = self._journal
        assert journal is not None
        self._session = None
        outcome = one_line(self._secrets.clean(session.end()))
        stream = session.stream
        self._resumable = stream.session
        self._totals = stream.totals or stream.before
        known = self._preset.format != "none"
        journal.record(SessionEnded(session.number, outcome, stream.usage if known else None))
        return outcome

    def _streamed(self, number: int, journal: Journal) -> Usage | None:
        """Return the recorded usage of a session that was cut off. Its cost is unknown."""
        if self._preset.format == "none":
            return None
        stream = Stream(self._preset.format)
        for line in read_lines(self._directory / "ledger.jsonl"):
            event = line.event
            if isinstance(event, Streamed) and event.session == number:
                for text in journal.get(event.lines).decode("utf-8", "replace").splitlines():
                    stream.feed(text)
        return replace(stream.usage, cost=None)


def command_agent(
    prepared: Prepared, preset: Preset, rules: CommandRules, leg: int = 0
) -> CommandAgent:
    """A coding agent with its folder, to be closed after the search; leg: its place in a relay.
    Raises UserError when a cap cannot be kept or the agent's program cannot be run."""
    check_rules(preset, rules)
    directory, started = prepared.directory, prepared.started
    if rules.jail:
        check_access(rules, directory, prepared.problem)
    check_program(preset.start[0], rules if rules.jail else None)
    # One level below the folder of runs, so that its contents are never listed as runs.
    folder = directory.resolve().parent / WORKSPACES / directory.name
    if os.path.lexists(folder / "ledger.jsonl"):
        raise UserError(f"{folder} contains ledger.jsonl, so it looks like a run: remove this file")
    write_folder(
        folder, prepared.problem, started.experiments, seed=started.seed,
        confinement=rules.confinement if rules.jail else Confinement.OPEN,
    )  # fmt: skip
    name = started.legs[leg - 1].agent if leg else started.agent
    return CommandAgent(name, preset, rules, prepared, folder, leg)


def run_command(
    prepared: Prepared,
    preset: Preset,
    rules: CommandRules,
    on_event: OnEvent,
    on_start: Callable[[SearchView], None],
) -> SearchView:
    """Run a search with candidates from a coding agent, see `search`.

    Raises:
        UserError: as `command_agent`, before anything starts.
    """
    agent = command_agent(prepared, preset, rules)
    return search_beside(prepared, agent, (agent,), on_event, on_start)


def search_beside(
    prepared: Prepared,
    agent: Agent,
    processes: Sequence[CommandAgent],
    on_event: OnEvent,
    on_start: Callable[[SearchView], None],
    executor: Executor | None = None,
) -> SearchView:
    """Run a search and pass every event to its coding agents; close them afterwards. See
    `search`.
    """
    store = Store(prepared.directory / "artifacts")

    def both(event: Event, view: SearchView) -> None:
        for process in processes:
            process.told(event, view, store)
        on_event(event, view)

    def begun(view: SearchView) -> None:
        for process in processes:
            process.started(view, store)
        on_start(view)

    try:
        return search(prepared, agent, both, begun, executor)
    finally:
        for process in processes:
            process.close()
