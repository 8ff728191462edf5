"""Who proposes candidates. Agents see a view and return source; they never touch the evaluator.

A new agent is one file here with a class that fulfils `Agent`, and one row in `AGENTS`.
"""

from __future__ import annotations

from asia.agents._expert import ExpertAgent
from asia.agents._random import RandomAgent
from asia.agents._view import Agent, AgentView, Facts, Proposal, Trial
from asia.errors import UserError

__all__ = [
    "AGENTS",
    "Agent",
    "AgentView",
    "ExpertAgent",
    "Facts",
    "Proposal",
    "RandomAgent",
    "Trial",
    "make_agent",
]

AGENTS: dict[str, type[Agent]] = {"expert": ExpertAgent, "random": RandomAgent}


def make_agent(name: str) -> Agent:
    """A built-in agent by name. Raises UserError for an unknown one."""
    if name not in AGENTS:
        raise UserError(f"no agent '{name}'; there is: {', '.join(AGENTS)}")
    return AGENTS[name]()
