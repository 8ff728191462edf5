"""Presets of coding agents, their event streams, and their rules."""

import json
import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from asia._text import printable_line
from asia.errors import UserError
from asia.ledger.events import Usage

# Event streams of coding agents: tokens, cost, turns, session, result.
#
# Formats: Claude Code `--output-format stream-json`, Codex `exec --json`, Gemini CLI `-o stream-
# json`. Lines that do not parse are ignored: the whole stream is in the ledger anyway.


StreamFormat = Literal["claude", "codex", "gemini", "none"]


@dataclass
class Stream:
    """Values reported by one session's stream so far."""

    format: StreamFormat
    """Format of the lines."""
    before: Usage = field(default_factory=lambda: Usage(cost=0.0))
    """The agent's own totals when a session that is taken up again was left; its totals hold them
    again."""
    usage: Usage = field(default_factory=Usage)
    """Usage of this process alone."""
    session: str = ""
    """The agent's name of the session, to take it up again."""
    outcome: str = ""
    """The agent's own word for its end."""
    totals: Usage | None = None
    """The agent's own totals as they stand now; None until they are reported."""
    _counted: set[str] = field(default_factory=set[str])

    def feed(self, line: str) -> None:
        """Parse one line of the stream."""
        try:
            event: Any = json.loads(line)
        except (ValueError, RecursionError):
            return
        if isinstance(event, dict):
            match self.format:
                case "claude":
                    self._read_claude(event)
                case "codex":
                    self._read_codex(event)
                case "gemini":
                    self._read_gemini(event)
                case "none":
                    pass

    def _add(self, tokens_in: int, tokens_out: int, cached: int, turns: int) -> None:
        u = self.usage
        self.usage = replace(
            u,
            input_tokens=u.input_tokens + tokens_in,
            output_tokens=u.output_tokens + tokens_out,
            cached_tokens=u.cached_tokens + cached,
            turns=u.turns + turns,
        )

    def _read_claude(self, event: dict[str, Any]) -> None:
        self.session = _name(event.get("session_id")) or self.session
        if event.get("type") == "assistant":
            message = _table(event.get("message"))
            # One reply may have several events.
            reply = _text(message.get("id")) or str(len(self.outcome))
            if reply not in self._counted:
                self._counted.add(reply)
                usage = _table(message.get("usage"))
                cached = _count(usage, "cache_read_input_tokens")
                fresh = _count(usage, "input_tokens") + _count(usage, "cache_creation_input_tokens")
                self._add(fresh + cached, _count(usage, "output_tokens"), cached, 1)
        elif event.get("type") == "result":
            self.outcome = _text(event.get("subtype")) or "result"
            # Both totals are those of the whole session, of what was resumed too.
            before, now = self.before, self.usage
            totals = self.totals or before
            cost = event.get("total_cost_usd")
            if isinstance(cost, int | float) and not isinstance(cost, bool) and math.isfinite(cost):
                totals = replace(totals, cost=float(cost))
                now = replace(now, cost=max(0.0, float(cost) - (before.cost or 0.0)))
            models = [_table(m) for m in _table(event.get("modelUsage")).values()]
            if models:
                # With sub-agents; before the end only the main loop is reported.
                made = sum(_count(m, "outputTokens") for m in models)
                cached = sum(_count(m, "cacheReadInputTokens") for m in models)
                read = cached + sum(
                    _count(m, "inputTokens") + _count(m, "cacheCreationInputTokens") for m in models
                )
                totals = replace(
                    totals, input_tokens=read, output_tokens=made, cached_tokens=cached
                )
                now = replace(
                    now,
                    input_tokens=max(now.input_tokens, read - before.input_tokens),
                    output_tokens=max(now.output_tokens, made - before.output_tokens),
                    cached_tokens=max(now.cached_tokens, cached - before.cached_tokens),
                )
            self.totals, self.usage = totals, now

    def _read_codex(self, event: dict[str, Any]) -> None:
        kind = event.get("type")
        if kind == "thread.started":
            self.session = _name(event.get("thread_id"))
        elif kind == "turn.completed":
            usage = _table(event.get("usage"))
            names = ("input_tokens", "output_tokens", "cached_input_tokens")
            self._add(*(_count(usage, name) for name in names), turns=1)
            self.outcome = "success"
        elif kind in ("turn.failed", "error"):
            self.outcome = "error"

    def _read_gemini(self, event: dict[str, Any]) -> None:
        kind = event.get("type")
        if kind == "init":
            self.session = _name(event.get("session_id"))
        elif kind == "message" and event.get("role") == "assistant" and not event.get("delta"):
            self._add(0, 0, 0, turns=1)
        elif kind == "error":
            self.outcome = "error"
        elif kind == "result":
            stats = _table(event.get("stats"))
            names = ("input_tokens", "output_tokens", "cached")
            self._add(*(_count(stats, name) for name in names), turns=0)
            self.outcome = _text(event.get("status")) or "success"


def _table(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _text(value: object) -> str:
    """Printable: no escape code and no half of a character leaves here."""
    return printable_line(value[:200]) if isinstance(value, str) else ""


def _name(value: object) -> str:
    """Return the name of a session, checked: it goes back onto a command line, where it must not be
    read as an option.
    """
    text = _text(value)
    return text if re.fullmatch(r"\w[\w.-]*", text) else ""


def _count(table: dict[str, Any], name: str) -> int:
    value = table.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0


# Coding agents as command lines. `{prompt}`, `{prompt_file}`, `{workspace}`, `{session}` and,
# where there is a cap on money, `{dollars}` are filled in.


@dataclass(frozen=True)
class Preset:
    """Command line and stream format of a coding agent."""

    start: tuple[str, ...]
    """Template of its arguments."""
    resume: tuple[str, ...] = ()
    """The same, to take a session up again; empty where it cannot."""
    dollars: tuple[str, ...] = ()
    """Arguments that tell it its cap on money."""
    model: tuple[str, ...] = ()
    """Arguments before the name of a model."""
    format: StreamFormat = "none"
    """Format of its stream."""
    keys: tuple[str, ...] = ()
    """Environment variables that hold its credentials."""
    config: str = ""
    """Its own folder below the home directory."""
    tells_cost: bool = False
    """True if its stream reports the cost."""
    tells_late: bool = False
    """True if it reports tokens only at the end of a turn or session, so that a cap may be exceeded
    considerably.
    """


_CLAUDE = (
    "claude", "--output-format", "stream-json", "--verbose", "--permission-mode",
    "bypassPermissions", "--strict-mcp-config", "--setting-sources", "",
)  # fmt: skip
# The jail is the sandbox: Codex cannot start its own inside.
_CODEX = ("--json", "--skip-git-repo-check", "--sandbox", "danger-full-access", "-c",
          'approval_policy="never"')  # fmt: skip

PRESETS: Mapping[str, Preset] = {
    "claude": Preset(
        start=(*_CLAUDE, "-p", "{prompt}"),
        resume=(*_CLAUDE, "--resume", "{session}", "-p", "{prompt}"),
        dollars=("--max-budget-usd", "{dollars}"),
        model=("--model",),
        format="claude",
        keys=("ANTHROPIC_API_KEY",),
        config=".claude",
        tells_cost=True,
    ),
    "codex": Preset(
        start=("codex", "exec", *_CODEX, "-C", "{workspace}", "{prompt}"),
        resume=("codex", "exec", "resume", "{session}", *_CODEX, "{prompt}"),
        model=("-m",),
        format="codex",
        keys=("OPENAI_API_KEY", "CODEX_API_KEY"),
        config=".codex",
        tells_late=True,
    ),
    "gemini": Preset(
        start=("gemini", "-p", "{prompt}", "-o", "stream-json", "--approval-mode", "yolo",
               "--skip-trust"),
        model=("-m",),
        format="gemini",
        keys=("GEMINI_API_KEY",),
        config=".gemini",
        tells_late=True,
    ),
}  # fmt: skip


def make_preset(name: str, command: str | None) -> Preset:
    """A known agent, or any command: `command` is its template. Raises UserError."""
    if name in PRESETS:
        if command is not None:
            raise UserError(
                "--command requires --agent command:NAME with a NAME of your own, not the "
                f"preset '{name}'"
            )
        return PRESETS[name]
    if command is None:
        raise UserError(
            f"--agent command:{name}: there is {', '.join(PRESETS)}; for any other program give "
            "its command line with --command, with {prompt} or {prompt_file} in it"
        )
    arguments = tuple(shlex.split(command))
    if not arguments or not any("{prompt}" in w or "{prompt_file}" in w for w in arguments):
        raise UserError("--command: expected a command line with {prompt} or {prompt_file} in it")
    return Preset(start=arguments)


def filled(template: tuple[str, ...], values: Mapping[str, str]) -> list[str]:
    """The arguments with every placeholder replaced; other braces stay."""
    found: list[str] = []
    for word in template:
        for name in ("prompt", "prompt_file", "workspace", "session", "dollars"):
            word = word.replace("{" + name + "}", values.get(name, ""))
        found.append(word)
    return found
