"""A coding agent as a process: started in a jail, watched, stopped, taken up again."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from asia.agents import AgentStoppedError, Journal, Preset, Stream, SubmittedAgent, filled
from asia.errors import UserError
from asia.ledger import (
    Evaluated,
    Event,
    SearchView,
    SessionEnded,
    StopReason,
    Store,
    Streamed,
    Usage,
)
from asia.sandbox import INSIDE, SOCKET_FOLDER, Jail, jail_environment
from asia.search._desk import RunDesk, one_line
from asia.search._loop import OnEvent
from asia.search._queue import Queue
from asia.search._search import Prepared, search
from asia.search._serve import clear_known, clearing, taking
from asia.search._socket import DeskServer
from asia.search._workspace import DESK_VARIABLE, write_folder, write_views

SOCKET = "desk.sock"
_CHUNK_BYTES = 256 * 1024
_LINE_BYTES = 4 * 1024 * 1024
_GRACE_SECONDS = 2.0
_LAST_WORDS_SECONDS = 60.0
_IDLE_SESSIONS = 2
_FIRST = (
    "Read PROGRAM.md in this folder and do what it says: find the best model you can, with "
    "`asia try`."
)
_AGAIN = (
    "Go on with the search that PROGRAM.md describes: read results.tsv and search_journal.md "
    "first. There are experiments left."
)


@dataclass(frozen=True)
class CommandRules:
    """What a command agent may use.

    minutes: wall-clock time of one sitting; tokens, cost: in all, None for no cap; stuck_minutes:
    without a new experiment; failures: experiments without a score in a row; network, mounts,
    configs: see `Jail`; variables: names of environment variables passed on; jail: False to run
    without one.
    """

    minutes: float | None = None
    tokens: int | None = None
    cost: float | None = None
    stuck_minutes: float = 30.0
    failures: int = 10
    network: bool = False
    mounts: tuple[Path, ...] = ()
    configs: tuple[Path, ...] = ()
    variables: tuple[str, ...] = ()
    jail: bool = True
    model: str | None = None


@dataclass
class Session:
    """One process of the agent. `ended` once it is over, with why the search should stop, None to
    start another."""

    process: subprocess.Popen[bytes]
    stream: Stream
    number: int
    experiments: int
    began: float = field(default_factory=time.monotonic)
    stopped: tuple[StopReason, str] | None = None
    lines: list[bytes] = field(default_factory=list[bytes])
    last_words: str = ""
    reader: threading.Thread | None = None

    def kill(self) -> None:
        """End it and all it started."""
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, sign)
            try:
                self.process.wait(_GRACE_SECONDS)
            except subprocess.TimeoutExpired:
                continue


class CommandAgent(SubmittedAgent):
    """Brings what its process hands in through the socket."""

    def __init__(
        self, name: str, preset: Preset, rules: CommandRules, prepared: Prepared, folder: Path
    ) -> None:
        self._preset, self._rules, self._folder = preset, rules, folder
        self._queue = Queue(prepared.directory)
        super().__init__(name, lambda: taking(self._queue), self._watch)
        self._session: Session | None = None
        self._view: SearchView | None = None
        self._journal_of: Journal | None = None
        self._socket = Path(tempfile.mkdtemp(prefix="asia-desk-"))
        self._server = DeskServer(self._socket / SOCKET, RunDesk(prepared.directory))
        self._last = time.monotonic()
        self._idle = 0
        self._resumable = ""
        self._paid = 0.0
        self._until = None if rules.minutes is None else time.monotonic() + 60 * rules.minutes

    def attach(self, journal: Journal) -> None:
        """Begin to serve the socket."""
        super().attach(journal)
        self._journal_of = journal
        self._server.__enter__()

    def close(self) -> None:
        """End the process and the socket, whatever happened."""
        if self._session is not None:
            self._session.kill()
        with contextlib.suppress(RuntimeError):
            self._server.__exit__(None, None, None)
        with contextlib.suppress(OSError):
            self._socket.rmdir()

    def told(self, event: Event, view: SearchView, store: Store) -> None:
        """An event was recorded: renew the views, count failures."""
        self._view = view
        clearing(self._queue, event)
        if isinstance(event, Evaluated):
            self._last = time.monotonic()
            write_views(self._folder, view, store)

    def stopped(self, reason: StopReason) -> None:
        """The search has stopped: where its budget is spent the agent may finish what it says."""
        session = self._session
        if session is None:
            return
        if reason in ("budget", "hours", "saturated"):
            with contextlib.suppress(subprocess.TimeoutExpired):
                session.process.wait(_LAST_WORDS_SECONDS)
        self._end_session(session.stream.outcome or "stopped with the search")

    def started(self, view: SearchView, store: Store) -> None:
        """The search begins or goes on."""
        self._view = view
        clear_known(self._queue, view)
        write_views(self._folder, view, store)

    def _watch(self, seconds: float) -> None:
        """Called while nothing is handed in: start, stop, judge the process."""
        del seconds
        if self._session is None:
            self._check_caps(self._spent(None))
            self._session = self._start()
            return
        session = self._session
        if session.stopped is None:
            session.stopped = self._overdue()
            if session.stopped is not None:
                session.kill()
        if session.process.poll() is None:
            return
        self._after(session)

    def _overdue(self) -> tuple[StopReason, str] | None:
        now, rules = time.monotonic(), self._rules
        if self._until is not None and now > self._until:
            return "time", f"{rules.minutes:g} minutes are over"
        if now - max(self._last, self._begun()) > 60 * rules.stuck_minutes:
            return "stuck", f"no new experiment in {rules.stuck_minutes:g} minutes"
        last = self._view.finished[-rules.failures :] if self._view is not None else ()
        if len(last) == rules.failures and all(e.score is None for e in last):
            return "stuck", f"{rules.failures} experiments in a row have no score"
        return None

    def _begun(self) -> float:
        return self._session.began if self._session is not None else 0.0

    def _after(self, session: Session) -> None:
        """The process has ended by itself or was killed."""
        outcome = session.stream.outcome or (
            f"exit code {session.process.returncode}: {one_line(session.last_words)}"
        )
        self._end_session(outcome)
        if session.stopped is not None:
            raise AgentStoppedError(*session.stopped)
        self._check_caps(self._spent(None))
        brought = (self._view is not None) and len(self._view.experiments) > session.experiments
        self._idle = 0 if brought else self._idle + 1
        if self._idle >= _IDLE_SESSIONS:
            raise AgentStoppedError(
                "agent", f"it ended {self._idle} times without a new experiment, last: {outcome}"
            )

    def _spent(self, session: Session | None) -> Usage:
        """In all, what is in flight included."""
        past = self._view.usage if self._view is not None else None
        past = past or Usage(cost=0.0)
        if session is None:
            return past
        now = session.stream.usage
        return Usage(
            past.input_tokens + now.input_tokens,
            past.output_tokens + now.output_tokens,
            past.cached_tokens + now.cached_tokens,
            None if past.cost is None or now.cost is None else past.cost + now.cost,
            past.turns + now.turns,
        )

    def _check_caps(self, spent: Usage) -> None:
        reason = self._over(spent)
        if reason is not None:
            raise AgentStoppedError(*reason)

    def _over(self, spent: Usage) -> tuple[StopReason, str] | None:
        rules = self._rules
        if rules.tokens is not None and spent.tokens >= rules.tokens:
            return "tokens", f"{spent.tokens} of {rules.tokens} tokens"
        if rules.cost is not None and spent.cost is not None and spent.cost >= rules.cost:
            return "cost", f"{spent.cost:.2f} of {rules.cost:.2f} USD"
        return None

    def _start(self) -> Session:
        preset, rules = self._preset, self._rules
        view = self._view
        assert view is not None
        again = bool(view.sessions)
        template = preset.resume if again and self._resumable and preset.resume else preset.start
        prompt = _AGAIN if again else _FIRST
        notes = "".join(f"\n\nThe person says: {n.text}" for n in view.notes)
        (self._folder / "PROMPT.md").write_text(prompt + notes, "utf-8")
        left = None if rules.cost is None else rules.cost - (self._spent(None).cost or 0.0)
        if left is not None and preset.dollars:
            template = (*template, *preset.dollars)
        if rules.model is not None and preset.model:
            template = (*template, *preset.model, rules.model)
        place = INSIDE if rules.jail else str(self._folder)
        values = {
            "prompt": prompt + notes,
            "prompt_file": f"{place}/PROMPT.md",
            "workspace": place,
            "session": self._resumable,
            "dollars": "" if left is None else f"{left:.4f}",
        }
        process = self._spawn(filled(template, values))
        number = len(view.sessions) + 1
        stream = Stream(preset.format, self._paid if template is preset.resume else 0.0)
        session = Session(process, stream, number, len(view.experiments))
        session.reader = threading.Thread(target=self._read, args=(session,), daemon=True)
        session.reader.start()
        return session

    def _spawn(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        rules = self._rules
        passed = {n: os.environ[n] for n in rules.variables if n in os.environ}
        if rules.jail:
            jail = Jail(self._folder, self._socket, rules.mounts, rules.configs, rules.network)
            arguments = jail.command(arguments)
            environment = jail_environment() | {DESK_VARIABLE: f"{SOCKET_FOLDER}/{SOCKET}"}
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

    def _read(self, session: Session) -> None:
        """In a thread of its own: the whole stream into the ledger, caps as soon as they show."""
        stream = session.process.stdout
        assert stream is not None
        size = 0
        with contextlib.suppress(ValueError, OSError):
            while line := stream.readline(_LINE_BYTES):
                session.lines.append(line)
                size += len(line)
                text = line.decode("utf-8", "replace")
                session.last_words = text if text.strip() else session.last_words
                session.stream.feed(text)
                over = self._over(self._spent(session))
                if over is not None and session.stopped is None:
                    session.stopped = over
                    session.kill()
                if size > _CHUNK_BYTES:
                    self._flush(session)
                    size = 0

    def _flush(self, session: Session) -> None:
        lines, session.lines = session.lines, []
        journal = self._journal_of
        if lines and journal is not None:
            journal.record(Streamed(session.number, journal.put(b"".join(lines))))

    def _end_session(self, outcome: str) -> None:
        session, journal = self._session, self._journal_of
        assert session is not None
        assert journal is not None
        session.kill()
        if session.reader is not None:
            session.reader.join(_GRACE_SECONDS)
        if session.process.stdout is not None:
            session.process.stdout.close()
        self._session = None
        self._flush(session)
        self._resumable = session.stream.session
        if session.stream.total_cost is not None:
            self._paid = session.stream.total_cost
        known = self._preset.format != "none"
        journal.record(
            SessionEnded(session.number, outcome, session.stream.usage if known else None)
        )


def run_command(
    prepared: Prepared,
    preset: Preset,
    rules: CommandRules,
    on_event: OnEvent,
    on_start: Callable[[SearchView], None],
) -> SearchView:
    """As `search`, with candidates from a coding agent. Raises UserError before anything starts
    when a cap cannot be kept."""
    check_rules(preset, rules)
    directory = prepared.directory
    folder = directory.with_name(f"{directory.name}-workspace").resolve()
    write_folder(folder, prepared.problem, prepared.started.experiments)
    name = prepared.started.agent
    agent = CommandAgent(name, preset, rules, prepared, folder)
    store = Store(directory / "artifacts")

    def both(event: Event, view: SearchView) -> None:
        agent.told(event, view, store)
        on_event(event, view)

    def begun(view: SearchView) -> None:
        agent.started(view, store)
        on_start(view)

    try:
        return search(prepared, agent, both, begun)
    finally:
        agent.close()


def check_rules(preset: Preset, rules: CommandRules) -> None:
    """Raises UserError for a cap that this agent's stream cannot keep."""
    if rules.cost is not None and not preset.tells_cost:
        raise UserError(
            "--max-cost: this agent does not tell what it costs; cap it with --max-tokens or "
            "--agent-minutes"
        )
    if rules.tokens is not None and preset.format == "none":
        raise UserError(
            "--max-tokens: nothing is known of this agent's stream; cap it with --agent-minutes"
        )
