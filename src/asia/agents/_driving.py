"""Interface between the search and agents that wait, ask a language model or run as a command."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from asia.errors import UserError
from asia.ledger import Event, Exchanged, StopReason


class InterruptedWaitError(Exception):
    """Error of an agent that waits, when the search has another task first; the agent is called
    again."""


class AgentStoppedError(Exception):
    """Raised by an agent that ends the search, with the reason that the ledger will give."""

    def __init__(self, reason: StopReason, detail: str = "") -> None:
        super().__init__(detail or reason)
        self.reason: StopReason = reason
        self.detail = detail


class DivergedError(UserError):
    """Error in a replay: the agent requests something that the record does not hold."""


class Journal(Protocol):
    """Journal of an attached agent: written from any thread, read again after a restart."""

    @property
    def exchanges(self) -> tuple[Exchanged, ...]:
        """All requests made so far, those of earlier sittings too."""
        ...

    @property
    def experiments(self) -> int:
        """Candidates proposed so far."""
        ...

    def record(self, event: Event) -> None:
        """Append an event to the ledger; on return it is on the disk."""
        ...

    def put(self, data: bytes) -> str:
        """Keep bytes; their name."""
        ...

    def get(self, name: str) -> bytes:
        """Bytes kept earlier."""
        ...

    def interrupted(self) -> bool:
        """Return whether the user has a note, a pause or a stop for the search."""
        ...


@runtime_checkable
class ProposesAhead(Protocol):
    """Agent that can propose before earlier proposals have their results: it reads `view.running`,
    and proposes no candidate listed there."""

    proposes_ahead: bool
    """Whether it does."""


def proposes_ahead(agent: object) -> bool:
    """Return whether an agent may be asked while others of its proposals run."""
    return isinstance(agent, ProposesAhead) and agent.proposes_ahead


@runtime_checkable
class Configured(Protocol):
    """Agent whose settings shape its proposals."""

    def recorded(self) -> dict[str, str]:
        """The settings for the ledger, without secrets."""
        ...


def settings_of(agent: object) -> dict[str, str]:
    """Return an agent's settings for the ledger; empty for an agent without settings."""
    return agent.recorded() if isinstance(agent, Configured) else {}


@runtime_checkable
class Closing(Protocol):
    """An agent that has something to end when the search is over."""

    def stopped(self, reason: StopReason) -> None:
        """The search has stopped. Called once, before the winner is fitted on all data."""
        ...

    def leaving(self) -> None:
        """Called last, after an error or an interrupt too; the journal still takes events."""
        ...


@runtime_checkable
class Attached(Protocol):
    """An agent that keeps a journal."""

    def attach(self, journal: Journal) -> None:
        """Called once, before the first proposal."""
        ...
