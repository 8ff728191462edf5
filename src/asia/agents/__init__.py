"""Agents, which propose candidates from a view of the search and never touch the evaluator.

A new agent is one file here with a class that fulfils `Agent`, and one row in `AGENT_ROWS` of
`registry.py`.
"""

from __future__ import annotations

from asia.agents.bayes import BayesAgent
from asia.agents.expert.agent import ExpertAgent
from asia.agents.library.pages import families_page, family_page
from asia.agents.library.registry import all_families
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.prompt import MODEL_RULES, briefing, equations, ladder_rule, symmetries
from asia.agents.llm.settings import LlmSettings
from asia.agents.random import SPACES, RandomAgent, SpaceName
from asia.agents.registry import (
    AGENT_ROWS,
    AGENTS,
    RESERVED,
    AgentRow,
    NamedAgent,
    asked_relay,
    choose_agent,
    make_agent,
    packages_of,
    reads_notes,
    recorded_agent,
    recorded_agents,
)
from asia.agents.relay import (
    LegPlan,
    RelayAgent,
    Runner,
    agent_of_leg,
    check_legs,
    check_relay_budget,
    legs_of,
    make_runner,
    relay_budget,
    relay_name,
)
from asia.agents.view import (
    Agent,
    AgentStoppedError,
    AgentView,
    Attached,
    Closing,
    DivergedError,
    Effort,
    Facts,
    InterruptedWaitError,
    Journal,
    Proposal,
    Running,
    SubmittedAgent,
    Trial,
    proposes_ahead,
    settings_of,
)

__all__ = [
    "AGENTS",
    "AGENT_ROWS",
    "MODEL_RULES",
    "RESERVED",
    "SPACES",
    "Agent",
    "AgentRow",
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
    "LegPlan",
    "LlmAgent",
    "LlmSettings",
    "NamedAgent",
    "Proposal",
    "RandomAgent",
    "RelayAgent",
    "Runner",
    "Running",
    "SpaceName",
    "SubmittedAgent",
    "Trial",
    "agent_of_leg",
    "all_families",
    "asked_relay",
    "briefing",
    "check_legs",
    "check_relay_budget",
    "choose_agent",
    "equations",
    "families_page",
    "family_page",
    "ladder_rule",
    "legs_of",
    "make_agent",
    "make_runner",
    "packages_of",
    "proposes_ahead",
    "reads_notes",
    "recorded_agent",
    "recorded_agents",
    "relay_budget",
    "relay_name",
    "settings_of",
    "symmetries",
]
