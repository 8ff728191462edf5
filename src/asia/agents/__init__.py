"""Agents, which propose candidates from a view of the search and never touch the evaluator.

A new agent is one file here with a class that fulfils `Agent`, and one row in `AGENT_ROWS` of
`registry.py`.
"""

from asia.agents.registry import make_agent
from asia.agents.view import Agent, AgentStoppedError, AgentView, Facts, Proposal, Running, Trial

__all__ = [
    "Agent",
    "AgentStoppedError",
    "AgentView",
    "Facts",
    "Proposal",
    "Running",
    "Trial",
    "make_agent",
]
