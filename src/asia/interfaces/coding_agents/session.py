"""One process of a coding agent: started in a jail, read, capped, ended, on a terminal or not."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from asia._text import one_line
from asia.agents.view import (
    Agent,
    AgentStoppedError,
    AgentView,
    Journal,
    Proposal,
    SubmittedAgent,
)
from asia.errors import UserError
from asia.interfaces.coding_agents.presets import Preset, Stream, filled
from asia.interfaces.workspace.process import Queue, clear_known, clearing, start_search
from asia.interfaces.workspace.program import Confinement
from asia.interfaces.workspace.server import DeskServer, RunDesk, SearchProgress
from asia.interfaces.workspace.workspace import (
    DESK_VARIABLE,
    Workspace,
    write_file,
    write_folder,
    write_views,
)
from asia.judge.executors import Executor
from asia.judge.sandbox.jail import INSIDE, SOCKET_FOLDER, Jail, jail_environment
from asia.judge.sandbox.types import Isolation
from asia.ledger.artifacts import Store
from asia.ledger.chain import read_lines
from asia.ledger.events import (
    Evaluated,
    Event,
    SessionEnded,
    SessionStarted,
    StopReason,
    Streamed,
    Usage,
)
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.problem import Problem
from asia.search.loop import OnEvent
from asia.search.run import Prepared, check_hidden_from_agent, search
from asia.search.steering import Steering

# Access of a jailed program besides its workspace, with a check that it does not include the runs.


@dataclass(frozen=True)
class Access:
    """Access of a jailed program."""

    network: bool = False
    """True if it reaches the network."""
    mounts: tuple[Path, ...] = ()
    """Folders that it sees, read-only."""
    configs: tuple[Path, ...] = ()
    """Its own files and folders, of which it gets a copy."""
    variables: tuple[str, ...] = ()
    """Names of environment variables passed on."""

    @property
    def confinement(self) -> Confinement:
        """Confinement of a jail with this access."""
        return Confinement.JAIL_WITH_NETWORK if self.network else Confinement.JAIL


def check_access(access: Access, directory: Path, problem: Problem) -> None:
    """Raises UserError when a folder would show the program the runs, the test data or their
    key."""
    runs = directory.resolve().parent
    for path in (*access.mounts, *access.configs):
        real = path.resolve()
        if real == runs or real in runs.parents or runs in real.parents:
            raise UserError(
                f"{path} would show the agent the runs in {runs}, whose ledgers it must "
                "not see: give a smaller folder, or another folder for the runs with "
                "--runs"
            )
    check_hidden_from_agent((*access.mounts, *access.configs), problem)


def check_program(program: str, access: Access | None) -> None:
    """Raises UserError when the program cannot be run in a jail with this access; None: outside."""
    jail = None if access is None else Jail(Path(), Path(), access.mounts)
    if (shutil.which(program) if jail is None else jail.find(program)) is None:
        raise UserError(
            f"the agent's program '{program}' cannot be run: install it. If it is installed "
            "in your home, give --agent-mount for its folder and for the folder that its "
            "link leads to"
        )


def copied_configs(access: Access, home: Path) -> tuple[Path, ...]:
    """The program's own files as a copy in `home`, which is made: what it changes there is lost
    with it."""
    home.mkdir()
    for path in access.configs:
        if path.is_dir():
            # Sockets and unreadable files are skipped.
            with contextlib.suppress(shutil.Error):
                shutil.copytree(path, home / path.name, symlinks=True, dirs_exist_ok=True)
        else:
            shutil.copy(path, home / path.name)
    return tuple(home / path.name for path in access.configs)


# Limits of a command agent, its usage so far, and the secrets that must not be recorded.


_HIDDEN = "[hidden]"


class StopCause(NamedTuple):
    """Why an agent was stopped."""

    reason: StopReason
    """Name of the reason in the ledger."""
    detail: str
    """The same for people, with figures."""


@dataclass(frozen=True)
class CommandRules(Access):
    """Limits of a command agent: its access and its caps."""

    minutes: float | None = None
    """Most minutes of wall-clock time in one sitting; None for no cap."""
    tokens: int | None = None
    """Most tokens in all; None for no cap."""
    cost: float | None = None
    """Most USD in all; None for no cap."""
    stuck_minutes: float = 30.0
    """Minutes without a new experiment, while the search waits for one, that end it."""
    failures: int = 10
    """Experiments of one sitting in a row without a score that end it."""
    jail: bool = True
    """False to run it without a jail."""
    model: str | None = None
    """The model that it is asked to use; None for its own choice."""


@dataclass(frozen=True)
class Spent:
    """Usage of all sessions, including the present ones."""

    tokens: int
    """Input and output tokens."""
    cost: float
    """Known part of the cost, USD."""
    unknown: float
    """Upper bound of the cost of sessions that ended without telling it, USD."""

    @classmethod
    def of(cls, view: SearchView, streams: Sequence[Stream]) -> Spent:
        """Return the usage from the ledger and the streams of the present sessions."""
        now = [stream.usage for stream in streams]
        grants = {event.session: event.grant for event in view.begun}
        tokens, cost = sum(u.tokens for u in now), sum(u.cost or 0.0 for u in now)
        unknown = 0.0
        for session in view.sessions:
            usage = session.usage or Usage()
            tokens += usage.tokens
            cost += usage.cost or 0.0
            if usage.cost is None:
                unknown += grants.get(session.session) or 0.0
        return cls(tokens, cost, unknown)

    def over(self, rules: CommandRules) -> StopCause | None:
        """The cap that is reached."""
        if rules.tokens is not None and self.tokens >= rules.tokens:
            return StopCause("tokens", f"{self.tokens} of {rules.tokens} tokens")
        if rules.cost is not None and self.cost + self.unknown >= rules.cost:
            more = ""
            if self.unknown:
                more = (
                    f", and up to {self.unknown:.2f} USD in sessions that did not report their cost"
                )
            return StopCause("cost", f"{self.cost:.2f} of {rules.cost:.2f} USD{more}")
        return None


@dataclass(frozen=True)
class Secrets:
    """Values that must not be written down, longest first."""

    values: tuple[str, ...]

    @classmethod
    def of(cls, variables: Iterable[str]) -> Secrets:
        """Return the secrets in environment variables, plain and JSON-encoded."""
        plain = {os.environ.get(name, "") for name in variables}
        known = {form for v in plain for form in (v, json.dumps(v)[1:-1])}
        # Shorter values are part of ordinary words.
        long = [value for value in known if len(value) >= 6]
        return cls(tuple(sorted(long, key=len, reverse=True)))

    def clean(self, text: str) -> str:
        """Return the text with every secret replaced."""
        for value in self.values:
            text = text.replace(value, _HIDDEN)
        return text

    def clean_bytes(self, data: bytes) -> bytes:
        """Return the bytes with every secret replaced."""
        for value in self.values:
            data = data.replace(value.encode("utf-8", "surrogateescape"), _HIDDEN.encode())
        return data

    def clean_proposal(self, proposal: Proposal) -> Proposal:
        """Return the proposal with every secret in its texts replaced."""
        texts = ("source", "family", "title", "hypothesis", "expected")
        return replace(proposal, **{name: self.clean(getattr(proposal, name)) for name in texts})


def check_rules(preset: Preset, rules: CommandRules) -> None:
    """Raises UserError for a cap that this agent's stream cannot keep."""
    if rules.cost is not None and not preset.tells_cost:
        raise UserError(
            "--max-cost: this agent does not report its cost; limit it with --max-tokens or "
            "--agent-minutes"
        )
    if rules.tokens is not None and preset.format == "none":
        raise UserError(
            "--max-tokens: ASIA cannot read tokens from this agent's output; limit it with "
            "--agent-minutes"
        )
    if rules.tokens is not None and preset.tells_late and rules.minutes is None:
        raise UserError(
            "--max-tokens: this agent reports its tokens only at the end of a turn or "
            "session, when they may be far above the limit; give --agent-minutes as well"
        )


# Process of a coding agent: start, output, deadline and end.


_TICK_SECONDS = 0.2
_FLUSH_SECONDS = 5.0
_READ_BYTES = 64 * 1024
_CHUNK_BYTES = 256 * 1024
_LINE_BYTES = 4 * 1024 * 1024


class Session:
    """A process, with a thread of its own that alone reads its output, until it is over.

    keep: given the output in whole lines, every few seconds; judge: asked all the time for a reason
    to kill it. `stopped` is that reason, `error` what went wrong in the thread.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        stream: Stream,
        number: int,
        experiments: int,
        keep: Callable[[int, bytes], None],
        judge: Callable[[Stream], StopCause | None],
    ) -> None:
        self.process, self.stream = process, stream
        self.number, self.experiments = number, experiments
        self.stopped: StopCause | None = None
        self.error: Exception | None = None
        self._keep, self._judge = keep, judge
        self._last_words = ""
        self._rest, self._whole = b"", bytearray()
        self._kept = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._attend, daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Return whether the process has ended."""
        return self.process.poll() is not None

    def wait(self, seconds: float) -> None:
        """Wait for the end of the process, at most `seconds`."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)

    def kill(self) -> None:
        """End the process and all of its group."""
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, sign)
            self.wait(2.0)

    def end(self) -> str:
        """Kill it, read what it has left; how it ended. A child that escaped its group may hold the
        output open: it is not waited for."""
        has_ended = self.ended
        self.kill()
        self._over.set()
        self._thread.join(10.0)
        if self.stream.outcome:
            return self.stream.outcome
        if self.stopped is not None:
            return f"stopped: {self.stopped.detail}"
        how = f"exit code {self.process.returncode}" if has_ended else "stopped with the search"
        return f"{how}: {self._last_words}" if self._last_words else how

    def _attend(self) -> None:
        output = self.process.stdout
        assert output is not None
        try:
            with output:
                self._follow(output.fileno())
        except Exception as error:  # noqa: BLE001 - the thread's border: the search raises it
            self.error = error
            self.kill()

    def _follow(self, output: int) -> None:
        os.set_blocking(output, False)
        poller = select.poll()
        poller.register(output, select.POLLIN)
        more = True
        while more or not self.ended:
            if self._over.is_set():
                # Not for ever: a child that escaped may go on writing.
                for _ in range(64):
                    more = more and self._read(output)
                break
            if not more:
                self._over.wait(_TICK_SECONDS)
            elif poller.poll(1000 * _TICK_SECONDS):
                more = self._read(output)
            self._flush()
            if self.stopped is None:
                self.stopped = self._judge(self.stream)
                if self.stopped is not None:
                    self.kill()
        if self._rest:
            self._take_line(self._rest)
        self._flush(at_once=True)

    def _read(self, output: int) -> bool:
        """Read the available output; return False at its end."""
        try:
            data = os.read(output, _READ_BYTES)
        except BlockingIOError:
            return True
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._take_line(line + b"\n")
        if len(self._rest) > _LINE_BYTES:
            self._take_line(self._rest)
            self._rest = b""
        return bool(data)

    def _take_line(self, line: bytes) -> None:
        self._whole += line
        text = line.decode("utf-8", "replace")
        self._last_words = text.strip() or self._last_words
        self.stream.feed(text)

    def _flush(self, *, at_once: bool = False) -> None:
        late = time.monotonic() - self._kept > _FLUSH_SECONDS
        if self._whole and (at_once or late or len(self._whole) > _CHUNK_BYTES):
            data, self._whole = bytes(self._whole), bytearray()
            self._kept = time.monotonic()
            self._keep(self.number, data)


# Coding agents that drive a search: started in jails, capped, stopped, taken up again.


SOCKET = "desk.sock"
WORKSPACES = ".workspaces"


@dataclass
class CodingAgent:
    """One coding agent of a search: its workspace, submission server and session."""

    name: str
    """Name in the ledger; "" where the search has one agent alone."""
    folder: Path
    """Its workspace."""
    server: DeskServer
    configs: tuple[Path, ...]
    """Its own copies of the configurations."""
    session: Session | None = None
    ended: StopCause | None = None
    """Why it is not started again."""
    quiet_since: float = 0.0
    looked: float = 0.0
    idle: int = 0
    """Sessions in a row without a new experiment."""
    resumable: str = ""
    totals: Usage = field(default_factory=lambda: Usage(cost=0.0))

    def experiments(self, view: SearchView) -> int:
        """Number of experiments that it proposed."""
        return sum(e.proposed.agent == self.name for e in view.experiments)


class CommandAgent(SubmittedAgent):
    """Brings what its coding agents hand in through their sockets, first come, first served, and
    what another agent beside them proposes.
    """

    def __init__(
        self,
        preset: Preset,
        rules: CommandRules,
        prepared: Prepared,
        folders: Mapping[str, Path],
        companion: Agent | None = None,
    ) -> None:
        """folders: workspaces of the coding agents by name, see `CodingAgent`. companion: proposes
        while nothing waits, no more than its share of the experiments."""
        super().__init__(prepared.started.agent, self._take)
        self._preset, self._rules, self._companion = preset, rules, companion
        self._directory = prepared.directory
        self._queue = Queue(prepared.directory)
        self._steering = Steering(prepared.directory)
        self._secrets = Secrets.of(rules.variables)
        self._view: SearchView | None = None
        self._asked: AgentView | None = None
        self._finished_before = 0
        self._private = Path(tempfile.mkdtemp(prefix="asia-agent-"))
        isolation = Isolation(prepared.started.isolation)
        self._agents: list[CodingAgent] = []
        for name, folder in folders.items():
            private = self._private / f"{len(self._agents)}"
            socket = private / "desk"
            socket.mkdir(parents=True)
            configs = copied_configs(rules, private / "home") if rules.jail else ()
            desk = RunDesk(prepared.directory, isolation=isolation, agent=name)
            server = DeskServer(socket / SOCKET, desk)
            self._agents.append(CodingAgent(name, folder, server, configs))
        self._until: float | None = None

    def attach(self, journal: Journal) -> None:
        """Begin to serve the sockets; account for sessions that were cut off."""
        super().attach(journal)
        view = self._view
        assert view is not None
        self._finished_before = len(view.finished)
        minutes = self._rules.minutes
        self._until = None if minutes is None else time.monotonic() + 60 * minutes
        ended = {event.session for event in view.sessions}
        for event in view.begun:
            if event.session not in ended:
                usage = None
                if self._preset.format != "none":
                    stream = self._recorded_stream(event.session, journal)
                    # The cost of a session that was cut off is unknown.
                    usage = replace(stream.usage, cost=None)
                journal.record(SessionEnded(event.session, "cut off with the search", usage))
        for agent in self._agents:
            agent.quiet_since = agent.looked = time.monotonic()
            agent.server.__enter__()

    def close(self) -> None:
        """End the sockets and remove what was private, whatever happened."""
        for agent in self._agents:
            if agent.session is not None:
                agent.session.end()
            agent.server.__exit__(None, None, None)
        shutil.rmtree(self._private, ignore_errors=True)

    def told(self, event: Event, view: SearchView, store: Store) -> None:
        """An event was written to the ledger: renew the views."""
        self._view = view
        clearing(self._queue, event)
        if isinstance(event, Evaluated):
            author = view.experiment(event.experiment).proposed.agent
            for agent in self._agents:
                if agent.name == author:
                    agent.quiet_since = time.monotonic()
                # An agent that makes its folder unwritable harms only itself.
                with contextlib.suppress(UserError):
                    write_views(agent.folder, view, store)

    def started(self, view: SearchView, store: Store) -> None:
        """The search begins or goes on."""
        self._view = view
        clear_known(self._queue, view)
        for agent in self._agents:
            write_views(agent.folder, view, store)

    def propose(self, view: AgentView) -> Proposal:
        """The next candidate handed in, or one of the agent beside the coding agents."""
        self._asked = view
        return super().propose(view)

    def stopped(self, reason: StopReason) -> None:
        """The search has stopped: where its budget is spent the agents may finish what they say."""
        if reason in ("budget", "hours", "saturated"):
            end = time.monotonic() + 60.0
            for agent in self._agents:
                if agent.session is not None:
                    agent.session.wait(max(0.0, end - time.monotonic()))
        self.leaving()

    def leaving(self) -> None:
        """The search is left, by an error or an interrupt where sessions still go on."""
        for agent in self._agents:
            if agent.session is not None:
                self._finish(agent, agent.session)

    def _take(self) -> Proposal | None:
        """Start agents, or start them again, and return the submitted candidate, unless a cap was
        reached meanwhile. Candidates of agents that have all ended wait in the queue for the next
        sitting."""
        queue = self._queue
        waiting = {p.agent for ticket in queue.tickets() if (p := queue.get(ticket))}
        for agent in self._agents:
            if agent.ended is None:
                session = agent.session
                cause = self._judge(agent, None) if session is None else session.stopped
                if cause is not None:
                    if session is not None:
                        self._finish(agent, session)
                    self._end(agent, cause)
                elif agent.name not in waiting:
                    self._attend(agent)
        all_ended = all(agent.ended is not None for agent in self._agents)
        proposal = None if all_ended else queue.take()
        if proposal is not None:
            return self._secrets.clean_proposal(proposal)
        proposal = self._ask_companion()
        if proposal is None and all_ended:
            causes = [(agent.name, agent.ended) for agent in self._agents if agent.ended]
            details = (
                f"{name}: {cause.detail}" if name else cause.detail for name, cause in causes
            )
            raise AgentStoppedError(causes[-1][1].reason, "; ".join(details))
        return proposal

    def _ask_companion(self) -> Proposal | None:
        """Its proposal. It is asked once a view, unless a coding agent is at work and it has more
        experiments than the mean of these."""
        view, asked, companion = self._view, self._asked, self._companion
        if companion is None or asked is None:
            return None
        assert view is not None
        own = sum(e.proposed.agent == companion.name for e in view.experiments)
        others = sum(agent.experiments(view) for agent in self._agents)
        at_work = any(agent.ended is None for agent in self._agents)
        if at_work and own * len(self._agents) > others:
            return None
        self._asked = None
        try:
            proposal = companion.propose(asked)
        except AgentStoppedError:
            return None
        return proposal and replace(proposal, agent=companion.name)

    def _attend(self, agent: CodingAgent) -> None:
        session, view = agent.session, self._view
        assert view is not None
        if session is None:
            cost = self._rules.cost
            # All that is left may be granted to others: it waits until they end.
            if cost is None or self._grant(view, cost) > 0.0:
                agent.session = self._start(agent)
            return
        if session.error is not None:
            raise session.error
        if not session.ended:
            return
        outcome = self._finish(agent, session)
        view = self._view
        assert view is not None
        stop = session.stopped or self._spent(agent, None).over(self._rules)
        if stop is not None:
            self._end(agent, StopCause(stop.reason, f"{stop.detail}; last session: {outcome}"))
            return
        brought = agent.experiments(view) > session.experiments
        agent.idle = 0 if brought else agent.idle + 1
        if agent.idle >= 2:
            detail = f"it ended {agent.idle} times without a new experiment, last: {outcome}"
            self._end(agent, StopCause("agent", detail))

    def _end(self, agent: CodingAgent, cause: StopCause) -> None:
        """End an agent. Raises AgentStoppedError where the cause is a cap that all share."""
        agent.ended = cause
        if cause.reason not in ("stuck", "agent"):
            raise AgentStoppedError(*cause)

    def _spent(self, agent: CodingAgent, stream: Stream | None) -> Spent:
        """Return the usage of all, with that of the agent's present stream."""
        assert self._view is not None
        streams = [] if stream is None else [stream]
        streams += [s.stream for a in self._agents if a is not agent and (s := a.session)]
        return Spent.of(self._view, streams)

    def _judge(self, agent: CodingAgent, stream: Stream | None) -> StopCause | None:
        """Why an agent must stop, from any thread, while something is evaluated too."""
        now, rules, view = time.monotonic(), self._rules, self._view
        assert view is not None
        if view.pending is not None or self._queue.tickets() or self._steering.paused:
            agent.quiet_since += now - agent.looked
        agent.looked = now
        over = self._spent(agent, stream).over(rules)
        if over is not None:
            return over
        if self._until is not None and now > self._until:
            return StopCause("time", f"{rules.minutes:g} minutes are over")
        if stream is not None and now - agent.quiet_since > 60 * rules.stuck_minutes:
            return StopCause("stuck", f"no new experiment in {rules.stuck_minutes:g} minutes")
        sitting = view.finished[self._finished_before :]
        last = [e for e in sitting if e.proposed.agent == agent.name][-rules.failures :]
        if len(last) == rules.failures and all(e.score is None for e in last):
            return StopCause("stuck", f"{rules.failures} experiments in a row have no score")
        return None

    def _start(self, agent: CodingAgent) -> Session:
        preset, rules, view, journal = self._preset, self._rules, self._view, self._journal
        assert view is not None
        assert journal is not None
        number = 1 + max(len(view.begun), len(view.sessions))
        again = any(event.agent == agent.name for event in view.begun)
        # A jail has a new home each time: only a configuration folder outlives a session.
        kept = not rules.jail or preset.config in [path.name for path in agent.configs]
        resumes = bool(again and agent.resumable and preset.resume and kept)
        template = preset.resume if resumes else preset.start
        if again:
            prompt = (
                "Continue the search that PROGRAM.md describes: read results.tsv and "
                "search_journal.md first. There are experiments left."
            )
        else:
            prompt = (
                "Read PROGRAM.md in this folder and do what it says: find the best model you can, "
                "with `asia try`."
            )
        if agent.name:
            prompt += (
                f"\n\nYou are {agent.name}. Other agents work on this search as well and share its "
                "budget: results.tsv and search_journal.md hold their experiments too."
            )
        prompt += "".join(f"\n\nNote of the user: {n.text}" for n in view.notes)
        write_file(agent.folder, "PROMPT.md", prompt)
        left = None if rules.cost is None else self._grant(view, rules.cost)
        if left is not None and preset.dollars:
            template = (*template, *preset.dollars)
        if rules.model is not None and preset.model:
            template = (*template, *preset.model, rules.model)
        place = INSIDE if rules.jail else str(agent.folder)
        values = {
            "prompt": prompt,
            "prompt_file": f"{place}/PROMPT.md",
            "workspace": place,
            "session": agent.resumable,
            "dollars": "" if left is None else f"{left:.4f}",
        }
        if not resumes:
            agent.totals = Usage(cost=0.0)
        journal.record(SessionStarted(number, left, agent.name))
        agent.quiet_since = agent.looked = time.monotonic()
        process = self._spawn(agent, filled(template, values))
        stream = Stream(preset.format, agent.totals)
        brought = agent.experiments(view)
        return Session(process, stream, number, brought, self._keep, partial(self._judge, agent))

    def _grant(self, view: SearchView, cost: float) -> float:
        """Return the allowance of a session, USD: what the others under way may not spend, in equal
        parts for those that wait for one."""
        spent = Spent.of(view, ())
        under_way = {s.number for agent in self._agents if (s := agent.session)}
        granted = sum(e.grant or 0.0 for e in view.begun if e.session in under_way)
        waiting = sum(a.session is None and a.ended is None for a in self._agents)
        return (cost - spent.cost - spent.unknown - granted) / waiting

    def _spawn(self, agent: CodingAgent, arguments: list[str]) -> subprocess.Popen[bytes]:
        rules, socket = self._rules, agent.server.path
        passed = {n: os.environ[n] for n in rules.variables if n in os.environ}
        if rules.jail:
            jail = Jail(agent.folder, socket.parent, rules.mounts, agent.configs, rules.network)
            arguments = jail.command(arguments)
            environment = jail_environment(rules.mounts)
            environment[DESK_VARIABLE] = f"{SOCKET_FOLDER}/{SOCKET}"
        else:
            environment = {
                name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ
            } | {DESK_VARIABLE: str(socket)}
        try:
            return subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment | passed,
                cwd=agent.folder,
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

    def _finish(self, agent: CodingAgent, session: Session) -> str:
        """End a session and write its account; how it ended, in words."""
        journal = self._journal
        assert journal is not None
        agent.session = None
        outcome = one_line(self._secrets.clean(session.end()))
        stream = session.stream
        agent.resumable = stream.session
        agent.totals = stream.totals or stream.before
        known = self._preset.format != "none"
        journal.record(SessionEnded(session.number, outcome, stream.usage if known else None))
        return outcome

    def _recorded_stream(self, session: int, journal: Journal) -> Stream:
        stream = Stream(self._preset.format)
        for line in read_lines(self._directory / "ledger.jsonl"):
            event = line.event
            if isinstance(event, Streamed) and event.session == session:
                for text in journal.get(event.lines).decode("utf-8", "replace").splitlines():
                    stream.feed(text)
        return stream


def command_agent(
    prepared: Prepared,
    preset: Preset,
    rules: CommandRules,
    names: Sequence[str] = ("",),
    companion: Agent | None = None,
) -> CommandAgent:
    """Coding agents with their folders, to be closed after the search; names and companion as in
    `CommandAgent`. Raises UserError when a cap cannot be kept or the program cannot be run."""
    check_rules(preset, rules)
    directory, started = prepared.directory, prepared.started
    if rules.jail:
        check_access(rules, directory, prepared.problem)
    check_program(preset.start[0], rules if rules.jail else None)
    # Below the folder of runs, so that their contents are never listed as runs.
    place = directory.resolve().parent / WORKSPACES / directory.name
    folders = {name: place / name for name in names}
    for folder in folders.values():
        if os.path.lexists(folder / "ledger.jsonl"):
            raise UserError(
                f"{folder} contains ledger.jsonl, so it looks like a run: remove this file"
            )
        write_folder(
            folder, prepared.problem, started.experiments, seed=started.seed,
            confinement=rules.confinement if rules.jail else Confinement.OPEN,
        )  # fmt: skip
    return CommandAgent(preset, rules, prepared, folders, companion)


def search_with_process(
    prepared: Prepared,
    agent: Agent,
    process: CommandAgent,
    on_event: OnEvent,
    on_start: Callable[[SearchView], None],
    executor: Executor | None = None,
) -> SearchView:
    """Run a search and pass every event to its coding agent, which is `agent` or goes on after it;
    close it afterwards. See `search`.
    """
    store = Store(prepared.directory / "artifacts")

    def both(event: Event, view: SearchView) -> None:
        process.told(event, view, store)
        on_event(event, view)

    def begun(view: SearchView) -> None:
        process.started(view, store)
        on_start(view)

    try:
        return search(prepared, agent, both, begun, executor)
    finally:
        process.close()


# Program on its own pseudo-terminal, shown on the user's terminal: it cannot reach the terminal
# that other programs use.


def on_terminal() -> bool:
    """Return whether this process has the user's terminal."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def run_on_terminal(arguments: list[str], environment: Mapping[str, str], folder: Path) -> int:
    """Run it to its end; its exit code. Where standard input is no terminal it gets the streams of
    this process."""
    if not on_terminal():
        return subprocess.run(arguments, env=environment, cwd=folder, check=False).returncode
    ours, theirs = pty.openpty()
    try:
        _copy_size(ours)
        process = subprocess.Popen(
            arguments, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        # Keys reach the program one by one, Ctrl-C as well; its terminal keeps the user's size.
        keyboard = sys.stdin.fileno()
        settings = termios.tcgetattr(keyboard)
        on_resize = signal.signal(signal.SIGWINCH, lambda number, frame: _copy_size(ours))
        try:
            tty.setraw(keyboard)
            _relay(ours, process)
        finally:
            signal.signal(signal.SIGWINCH, on_resize)
            termios.tcsetattr(keyboard, termios.TCSADRAIN, settings)
        return process.wait()
    finally:
        os.close(ours)


def _relay(ours: int, process: subprocess.Popen[bytes]) -> None:
    """Copy both ways until the program has ended and nothing of its output is left."""
    keyboard, screen = sys.stdin.fileno(), sys.stdout.fileno()
    watched = [ours, keyboard]

    def copy(data: bytes, to: int) -> None:
        while data:
            data = data[os.write(to, data) :]

    while True:
        ready = select.select(watched, [], [], _TICK_SECONDS)[0]
        if keyboard in ready:
            typed = os.read(keyboard, _READ_BYTES)
            copy(typed, ours)
            if not typed:
                watched.remove(keyboard)
        if ours in ready:
            with contextlib.suppress(OSError):  # Linux answers EIO once the other end is closed
                shown = os.read(ours, _READ_BYTES)
                if shown:
                    copy(shown, screen)
                    continue
            return
        if not ready and process.poll() is not None:
            return


def _copy_size(ours: int) -> None:
    with contextlib.suppress(OSError):
        size = fcntl.ioctl(sys.stdin.fileno(), termios.TIOCGWINSZ, bytes(8))
        fcntl.ioctl(ours, termios.TIOCSWINSZ, size)


# Any program in the jail of a workspace: `asia agent workspace --jail CMD`.


def check_jail(words: list[str], access: Access, directory: Path, problem: Problem) -> None:
    """Raises UserError when there can be no jail here, the program cannot be run in it, or what is
    opened to it would show the runs or the test."""
    missing = Jail.why_not()
    if missing is not None:
        raise UserError(f"--jail: there can be no jail here ({missing}); see asia doctor")
    if not words:
        raise UserError("--jail: expected the command line of a program, such as bash or claude")
    check_access(access, directory, problem)
    check_program(words[0], access)


def run_jailed(place: Workspace, words: list[str], access: Access) -> int:
    """Run the program in the workspace's jail, to its end; its exit code. It submits through a
    socket; the search goes on in its own process afterwards. Raises UserError where the program
    cannot be started."""
    assert place.run is not None
    with tempfile.TemporaryDirectory(prefix="asia-agent-") as private:
        socket, home = Path(private) / "desk", Path(private) / "home"
        socket.mkdir()
        configs = copied_configs(access, home)
        jail = Jail(place.folder, socket, access.mounts, configs, access.network)
        passed = (*access.variables, "TERM", "COLORTERM")
        environment = {
            **jail_environment(access.mounts),
            DESK_VARIABLE: f"{SOCKET_FOLDER}/{SOCKET}",
            **{name: os.environ[name] for name in passed if name in os.environ},
        }
        with DeskServer(socket / SOCKET, _RenewingDesk(place)):
            try:
                command = jail.command(words, terminal=on_terminal())
                return run_on_terminal(command, environment, place.folder)
            except OSError as error:
                raise UserError(f"the jail could not be started: {error.strerror}") from None


class _RenewingDesk(RunDesk):
    """Submission server that writes the views of the workspace before it reports the state of the
    search, because a jailed program cannot read the ledger.
    """

    def __init__(self, place: Workspace) -> None:
        assert place.run is not None
        super().__init__(place.run, start_search)
        self._place, self._run_directory = place, place.run
        self._written = -1

    def progress(self) -> SearchProgress:
        """See `RunDesk.progress`."""
        now = super().progress()
        if now.experiments != self._written:
            opened = open_run(self._run_directory)
            # An agent that makes its folder unwritable harms only itself.
            with contextlib.suppress(UserError):
                write_views(self._place.folder, opened.view, opened.store)
            self._written = now.experiments
        return now
