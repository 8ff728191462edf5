"""The paper's own configurations as fixed candidates."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

from asia.agents import AgentView, Proposal

TITLES = {"rnn4": "RNN-4", "ltc64": "LTC/CfC-64"}


@dataclass(frozen=True)
class FixedAgent:
    """Proposes given candidates in order: (title, source) pairs."""

    candidates: tuple[tuple[str, str], ...]
    name: str = "references"

    def propose(self, view: AgentView) -> Proposal | None:
        """The next one; None after the last."""
        done = len(view.trials) - 1
        if done >= len(self.candidates):
            return None
        title, source = self.candidates[done]
        return Proposal(
            source=source,
            family="reference",
            title=title,
            hypothesis="The paper's configuration and recipe, rebuilt.",
            expected="The V that the paper reports, within the spread over seeds.",
        )


def reference_agent(names: tuple[str, ...]) -> FixedAgent:
    """The reference candidates of these names, see `TITLES`."""
    folder = resources.files("asia.bench") / "candidates"
    return FixedAgent(tuple((TITLES[n], (folder / f"{n}.py").read_text("utf-8")) for n in names))
