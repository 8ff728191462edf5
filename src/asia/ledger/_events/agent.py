"""Requests, answers and token usage of language models and coding agents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Usage:
    """Tokens and cost of a language model."""

    input_tokens: int = 0
    """Tokens of the requests."""
    output_tokens: int = 0
    """Tokens of the replies."""
    cached_tokens: int = 0
    """The part of `input_tokens` that the provider had cached."""
    cost: float | None = None
    """USD; None where it is not known."""
    turns: int = 0
    """Replies of the model."""

    @property
    def tokens(self) -> int:
        """Input and output together."""
        return self.input_tokens + self.output_tokens


@dataclass(frozen=True)
class Exchanged:
    """A request to a language model and its reply. Headers are not kept."""

    experiment: int
    """The experiment it was made for."""
    path: str
    """Path of the request."""
    request: str
    """Artifact of its body."""
    response: str
    """Artifact of the reply's body."""
    status: int
    """HTTP status; 0 when there was no reply."""
    usage: Usage | None = None
    """Tokens and cost of the exchange."""
    leg: int = 0
    """The leg of a relay that asked, 1-based; 0 where one agent proposes."""
    event: Literal["exchanged"] = "exchanged"


@dataclass(frozen=True)
class Streamed:
    """Output lines of an agent that runs as a command, as they came, in an artifact."""

    session: int
    """Number of the session."""
    lines: str
    """The artifact."""
    event: Literal["streamed"] = "streamed"


@dataclass(frozen=True)
class SessionStarted:
    """A command agent's process begins."""

    session: int
    """Number of the session."""
    grant: float | None
    """USD that it may spend; None where money has no cap."""
    leg: int = 0
    """Leg of a relay, see `Exchanged`."""
    event: Literal["session_started"] = "session_started"


@dataclass(frozen=True)
class SessionEnded:
    """A command agent's process has ended."""

    session: int
    """Number of the session."""
    outcome: str
    """Outcome of the session."""
    usage: Usage | None
    """Tokens and cost of the session."""
    leg: int = 0
    """Leg of a relay, see `Exchanged`."""
    event: Literal["session_ended"] = "session_ended"
