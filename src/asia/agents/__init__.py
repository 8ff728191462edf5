"""Who proposes candidates. Agents see a view and return source; they never touch the evaluator.

A new agent is one file here with a class that fulfils `Agent`, and one row in `AGENTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from asia.agents._driving import (
    AgentStoppedError,
    Attached,
    Closing,
    DivergedError,
    InterruptedWaitError,
    Journal,
    settings_of,
)
from asia.agents._submitted import SubmittedAgent
from asia.agents._view import Agent, AgentView, Effort, Facts, Proposal, Trial
from asia.agents.controls.bayes import BayesAgent
from asia.agents.controls.random import SPACES, RandomAgent, SpaceName
from asia.agents.expert.agent import ExpertAgent
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.problem import MODEL_RULES, briefing, equations, library
from asia.agents.llm.settings import LlmSettings
from asia.errors import UserError

__all__ = [
    "AGENTS",
    "MODEL_RULES",
    "SPACES",
    "Agent",
    "AgentStoppedError",
    "AgentView",
    "Attached",
    "BayesAgent",
    "Closing",
    "DivergedError",
    "Effort",
    "ExpertAgent",
    "Facts",
    "InterruptedWaitError",
    "Journal",
    "LlmAgent",
    "LlmSettings",
    "Proposal",
    "RandomAgent",
    "SpaceName",
    "SubmittedAgent",
    "Trial",
    "briefing",
    "equations",
    "library",
    "make_agent",
    "settings_of",
]

AGENTS: dict[str, Callable[[], Agent]] = {
    "expert": ExpertAgent,
    "random": RandomAgent,
    "random-paper": partial(RandomAgent, "paper"),
    "bayes": BayesAgent,
}


def make_agent(name: str, space: str | None = None) -> Agent:
    """A built-in agent by name. space: what `random` draws from, one of `SPACES`. Raises UserError
    for an unknown name or space, and for a space given to an agent that does not draw."""
    if space is not None and name != "random":
        raise UserError(
            f"--space {space}: only the agent 'random' draws from a space, not '{name}'"
        )
    if space is not None and space not in SPACES:
        raise UserError(f"--space {space}: expected one of {', '.join(SPACES)}")
    full = name if space in (None, "library") else f"{name}-{space}"
    if name == "llm":
        raise UserError(
            "the agent llm needs a model: asia run --agent llm --model NAME, or "
            "LlmAgent(LlmSettings(model=...))"
        )
    if full not in AGENTS:
        raise UserError(f"no agent '{name}'; there is: {', '.join(AGENTS)}")
    return AGENTS[full]()
