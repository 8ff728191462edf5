"""Candidates that are brought: by a person in a shell, a coding agent, a client of a server."""

from __future__ import annotations

import time
from collections.abc import Callable

from asia.agents._driving import InterruptedWaitError, Journal
from asia.agents._view import AgentView, Proposal

_POLL = 0.1


class SubmittedAgent:
    """Proposes what `take` gives, and waits while it gives nothing.

    waiting: called while nothing is there, with the seconds waited so far; it may raise
    AgentStoppedError to end the search, or any other exception to leave it as it is.
    """

    def __init__(
        self,
        name: str,
        take: Callable[[], Proposal | None],
        waiting: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        self._name, self._take, self._waiting = name, take, waiting
        self._journal: Journal | None = None

    @property
    def name(self) -> str:
        """Who brings them."""
        return self._name

    def attach(self, journal: Journal) -> None:
        """To be woken when a person has something to say."""
        self._journal = journal

    def propose(self, view: AgentView) -> Proposal:
        """The next one brought."""
        del view
        start = time.monotonic()
        while True:
            proposal = self._take()
            if proposal is not None:
                return proposal
            if self._journal is not None and self._journal.interrupted():
                raise InterruptedWaitError
            self._waiting(time.monotonic() - start)
            time.sleep(_POLL)
