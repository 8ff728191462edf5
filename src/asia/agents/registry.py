"""The agents by name: built in, brought by another package, or a class in a file."""

import os
import re
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import cast

from asia._plugins import Part, load_target, parts_of
from asia._text import one_line
from asia.agents.bayes import BayesAgent
from asia.agents.expert.agent import ExpertAgent
from asia.agents.leading import FOLLOWING, LeadingAgent, read_leading_settings
from asia.agents.library.family import Family
from asia.agents.library.registry import family
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.settings import LlmSettings
from asia.agents.random import RandomAgent
from asia.agents.view import Agent, settings_of
from asia.errors import UserError
from asia.ledger.events import Started
from asia.recipe import Recipe, read_recipe

GROUP = "asia.agents"
_CLASS = "class"


@dataclass(frozen=True)
class AgentRow:
    """Facts about an agent, known by its name alone."""

    name: str
    """Name on the command line and in the ledger."""
    help: str
    make: Callable[[], Agent] | None = None
    """Factory; None where an agent needs more than its name: a server, or a submitter."""
    packages: tuple[str, ...] = ()
    """Packages whose versions its proposals depend on."""

    reads_notes: bool = True
    """Whether notes of `asia steer` change its proposals."""
    writes_code: bool = True
    """Whether it writes candidates, which can print the training records; the others choose from
    the model library."""
    designs_controllers: bool = True
    """Whether it can propose controllers."""


AGENT_ROWS: tuple[AgentRow, ...] = (
    AgentRow(
        "expert",
        "rules of an experienced engineer, without a language model",
        ExpertAgent,
        writes_code=False,
    ),
    AgentRow(
        "random",
        "draws from the model library",
        RandomAgent,
        reads_notes=False,
        writes_code=False,
        designs_controllers=False,
    ),
    AgentRow(
        "bayes",
        "estimates where the library is best (Parzen estimator)",
        BayesAgent,
        reads_notes=False,
        writes_code=False,
        designs_controllers=False,
    ),
    AgentRow("llm", "a language model behind a server", packages=("openai", "httpx2")),
    AgentRow("workspace", "candidates that are submitted from a folder", designs_controllers=False),
    AgentRow(
        "leading",
        "the candidates that led another search, then another agent",
        designs_controllers=False,
    ),
    AgentRow("mcp", "candidates that a client of the server submits"),
)
AGENTS: dict[str, Callable[[], Agent]] = {r.name: r.make for r in AGENT_ROWS if r.make is not None}
COMPANION = "with"
"""Setting with the name of the built-in agent that proposes beside coding agents."""
RESERVED = frozenset(row.name for row in AGENT_ROWS)
"""Names that no other agent may have."""


def agent_row(name: str) -> AgentRow:
    """Return the facts about the agent with this name; the defaults where it is not built in."""
    return next((row for row in AGENT_ROWS if row.name == name), AgentRow(name, ""))


@dataclass(frozen=True)
class NamedAgent:
    """Agent with its record for the ledger besides its name."""

    agent: Agent
    settings: Mapping[str, str] = field(default_factory=dict[str, str])
    """Settings, and the class of an agent that is not built in."""


def choose_agent(name: str) -> NamedAgent:
    """Make an agent by name.

    A name is that of a built-in agent, one that a package registers, or `module:Class`, where the
    current folder is searched first. A class is called without arguments.

    Raises:
        UserError: for an unknown name, and a class that cannot be imported or is no agent
    """
    if name == "llm":
        raise UserError(
            "the agent llm needs a model: asia run --agent llm --model NAME, or "
            "LlmAgent(LlmSettings(model=...))"
        )
    if name in AGENTS:
        return NamedAgent(AGENTS[name]())
    brought = {part.name: part for part in parts_of(GROUP)}
    if name in brought and name not in RESERVED:
        return _called(brought[name])
    if ":" in name:
        return _called(name)
    known = ", ".join((*AGENTS, *sorted(brought.keys() - RESERVED)))
    raise UserError(f"no agent '{name}'; there is: {known}, or module:Class for one of your own")


def make_agent(name: str) -> Agent:
    """The agent of `choose_agent`."""
    return choose_agent(name).agent


def recorded_agent(
    name: str, settings: Mapping[str, str], trusted: Collection[str] = ()
) -> Agent | None:
    """Return the agent that a ledger names, to replay it; None for an external proposer.

    A language model answers from the ledger. Of the classes that a ledger names, only those of
    installed packages are imported, because the ledger may come from somebody else.

    Args:
        trusted: classes, `module:Class`, that may be imported too, also from the current folder

    Raises:
        UserError: the class is not installed and not trusted, or cannot be imported now
    """
    if name == "llm":
        return LlmAgent(LlmSettings.from_record(settings), network=False)
    if name == LeadingAgent.name:
        candidates, agent, rest = read_leading_settings(settings)
        following = recorded_agent(agent, rest, trusted)
        return None if following is None else LeadingAgent(candidates, following)
    if _CLASS in settings and name not in RESERVED:
        recorded = settings[_CLASS]
        for part in parts_of(GROUP):
            if part.target == recorded:
                return _called(part).agent
        for target in trusted:
            if target == recorded:
                return _called(target).agent
        raise UserError(
            f"the ledger names the agent class '{one_line(recorded, 200)}', which no installed "
            "package brings: it was not imported; if you trust its code, give --trust-agent "
            "with exactly this name"
        )
    make = AGENTS.get(settings.get(COMPANION, name))
    return make() if make is not None else None


def reads_notes(started: Started) -> bool:
    """Return whether the agent of the search reads notes; one that is not built in sees them."""
    name = started.agent
    if name == LeadingAgent.name:
        name = started.agent_settings.get(FOLLOWING, name)
    return agent_row(name).reads_notes


def can_read_records(name: str) -> bool:
    """Return whether this agent can read the training records, so that V alone is no evidence: all
    that write candidates, also those that are not built in."""
    return agent_row(name).writes_code


def library_candidate(source: str) -> tuple[Recipe, Family] | None:
    """Return a candidate of the model library as data, with its family; None for another source."""
    recipe = read_recipe(source)
    row = None if recipe is None else family(recipe.family)
    return None if recipe is None or row is None else (recipe, row)


def _called(named: Part | str) -> NamedAgent:
    """Import and make an agent of an installed package, or of a class that the user names, for
    which the current folder is searched first."""
    installed = isinstance(named, Part)
    target = named.target if installed else named
    what, here = f"--agent {target}", os.getcwd()
    if not installed:
        sys.path.insert(0, here)
    try:
        make = named.load() if installed else load_target(named, what)
        if not callable(make):
            raise UserError(f"{what}: expected a class that is called without arguments")
        try:
            agent: object = make()
        # Code of another package: whatever it raises is its failure, not ours.
        except Exception as error:
            raise UserError(
                f"{what}: calling it without arguments failed: {type(error).__name__}: {error}"
            ) from error
    finally:
        if not installed:
            sys.path.remove(here)
    name = getattr(agent, "name", None)
    if not isinstance(name, str) or not callable(getattr(agent, "propose", None)):
        raise UserError(f"{what}: not an agent: expected a `name` and a method `propose(view)`")
    if name in RESERVED or not re.fullmatch(r"\w[\w.+-]*", name):
        raise UserError(
            f"{what}: its name is '{name}': expected letters, digits and . _ + -, and none of "
            f"{', '.join(sorted(RESERVED))}"
        )
    return NamedAgent(cast("Agent", agent), {**settings_of(agent), _CLASS: target})
