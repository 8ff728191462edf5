"""Candidates that led an earlier search, proposed again with more data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Self

from asia.agents.view import AgentView, Proposal

_SETTING = "candidates"


@dataclass(frozen=True)
class LeadingCandidate:
    """A candidate of an earlier search."""

    family: str
    title: str
    source: str
    origin: str
    """Run, experiment and V."""


class LeadingAgent:
    """Proposes each candidate once, in order."""

    name = "leading"
    proposes_ahead = True

    def __init__(self, candidates: Sequence[LeadingCandidate]) -> None:
        self.candidates = tuple(candidates)

    @classmethod
    def from_record(cls, settings: Mapping[str, str]) -> Self:
        """Make the agent from its settings in a ledger."""
        rows: list[dict[str, str]] = json.loads(settings.get(_SETTING, "[]"))
        return cls([LeadingCandidate(**row) for row in rows])

    @property
    def settings(self) -> dict[str, str]:
        """The candidates, for the ledger."""
        return {_SETTING: json.dumps([asdict(one) for one in self.candidates])}

    def propose(self, view: AgentView) -> Proposal | None:
        """The next candidate that was not proposed yet; None after the last."""
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
        return None
