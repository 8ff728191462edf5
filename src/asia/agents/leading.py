"""Candidates that led an earlier search, proposed again with more data before an agent goes on."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from asia.agents.view import (
    Agent,
    AgentView,
    Attached,
    Closing,
    Journal,
    Proposal,
    proposes_ahead,
)
from asia.ledger.events import StopReason

FOLLOWING = "then"
"""Setting with the name of the agent that goes on."""
_CANDIDATES = "candidates"


@dataclass(frozen=True)
class LeadingCandidate:
    """A candidate of an earlier search."""

    family: str
    title: str
    source: str
    origin: str
    """Run, experiment and V."""


def leading_settings(
    candidates: Sequence[LeadingCandidate], agent: str, settings: Mapping[str, str]
) -> dict[str, str]:
    """Return the settings of a `LeadingAgent` for the ledger, with those of the agent that goes on
    after the candidates."""
    rows = json.dumps([asdict(one) for one in candidates])
    return {**settings, FOLLOWING: agent, _CANDIDATES: rows}


def read_leading_settings(
    settings: Mapping[str, str],
) -> tuple[list[LeadingCandidate], str, dict[str, str]]:
    """Return the candidates, and the name and settings of the agent that goes on after them."""
    rest = dict(settings)
    rows: list[dict[str, str]] = json.loads(rest.pop(_CANDIDATES, "[]"))
    agent = rest.pop(FOLLOWING, "")
    return [LeadingCandidate(**row) for row in rows], agent, rest


class LeadingAgent:
    """Proposes each candidate once, in order, then what another agent proposes."""

    name = "leading"

    def __init__(self, candidates: Sequence[LeadingCandidate], following: Agent) -> None:
        self.candidates = tuple(candidates)
        self.following = following

    @property
    def proposes_ahead(self) -> bool:
        """Whether the agent that goes on may be asked while its proposals run."""
        return proposes_ahead(self.following)

    def propose(self, view: AgentView) -> Proposal | None:
        """The next candidate that was not proposed yet; after the last the other agent's."""
        for one in self.candidates:
            if not view.is_known(one.source):
                return Proposal(
                    source=one.source,
                    family=one.family,
                    title=one.title,
                    hypothesis=f"It led an earlier search ({one.origin}) on fewer records.",
                    expected="A V close to the one it had there, if the new record holds no "
                    "surprise.",
                )
        return self.following.propose(view)

    def attach(self, journal: Journal) -> None:
        """Attach the agent that goes on."""
        if isinstance(self.following, Attached):
            self.following.attach(journal)

    def stopped(self, reason: StopReason) -> None:
        """Tell the agent that goes on."""
        if isinstance(self.following, Closing):
            self.following.stopped(reason)

    def leaving(self) -> None:
        """Tell the agent that goes on."""
        if isinstance(self.following, Closing):
            self.following.leaving()
