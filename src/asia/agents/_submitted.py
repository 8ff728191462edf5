"""Agent for submitted candidates: from a user in a shell, a coding agent, or a client of a
server."""

from __future__ import annotations

import time
from collections.abc import Callable

from asia.agents._driving import InterruptedWaitError, Journal
from asia.agents._view import AgentView, Proposal

_POLL = 0.1


class SubmittedAgent:
    """Agent that proposes the submissions of `take`, and waits while there are none.

    Args:
        waiting: called while there is no submission, with the seconds waited so far; it may
            raise AgentStoppedError to end the search, or any other exception to interrupt it
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
        """Name of the submitter."""
        return self._name

    def attach(self, journal: Journal) -> None:
        """Register to be woken when the user has a note or a request."""
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
