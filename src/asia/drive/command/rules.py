"""Limits of a command agent, its usage so far, and the secrets that must not be recorded."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

from asia.agents import Proposal
from asia.drive.command.access import Access
from asia.drive.command.presets import Preset
from asia.drive.command.stream import Stream
from asia.errors import UserError
from asia.ledger import SearchView, StopReason, Usage

_SHORTEST_SECRET = 6
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
    """Usage of all sessions, including the present one."""

    tokens: int
    """Input and output tokens."""
    cost: float
    """Known part of the cost, USD."""
    unknown: float
    """Upper bound of the cost of sessions that ended without telling it, USD."""

    @classmethod
    def of(cls, view: SearchView, stream: Stream | None, leg: int = 0) -> Spent:
        """Return the usage from the ledger and the stream of the present session; in a relay, of
        one leg.
        """
        now = stream.usage if stream is not None else Usage()
        grants = {event.session: event.grant for event in view.begun}
        tokens, cost, unknown = now.tokens, now.cost or 0.0, 0.0
        for session in (each for each in view.sessions if each.leg == leg):
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
            more = (
                f", and up to {self.unknown:.2f} USD in sessions that did not report their cost"
                if self.unknown
                else ""
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
        long = [value for value in known if len(value) >= _SHORTEST_SECRET]
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
        return replace(
            proposal,
            source=self.clean(proposal.source),
            family=self.clean(proposal.family),
            title=self.clean(proposal.title),
            hypothesis=self.clean(proposal.hypothesis),
            expected=self.clean(proposal.expected),
        )


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
