"""What proposes, as the run command sees it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia.agents import Agent, NamedAgent
    from asia.ledger import SearchView
    from asia.search import OnEvent, Prepared

    Search = Callable[[Prepared, OnEvent, Callable[[SearchView], None]], SearchView]


@dataclass(frozen=True)
class Driver:
    """What the command needs of an agent."""

    name: str
    """The agent's name, part of the run's name."""
    search: Search
    """Runs the search."""
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """What the ledger holds of the agent's settings, no keys among them."""
    words: tuple[str, ...] = ()
    """Said to the person beforehand."""


def named_agent(name: str, space: str | None) -> NamedAgent:
    """As `choose_agent`; the name of a coding agent is answered with how to call it."""
    from asia.agents import choose_agent
    from asia.drive.command import PRESETS
    from asia.errors import UserError

    if name in PRESETS:
        raise UserError(f"--agent {name}: write command:{name}, as for every coding agent")
    return choose_agent(name, space)


def refuse_for_others(agent: str, *, owners: Sequence[str], **given: object) -> None:
    """Raises UserError when an option of some agents was given to another: it would be lost."""
    from asia.errors import UserError

    kind = agent.partition(":")[0]
    whose = " or ".join("command:NAME" if o == "command" else o for o in owners)
    for name, value in given.items():
        if kind not in owners and value is not None:
            raise UserError(
                f"--{name.replace('_', '-')} is for --agent {whose}, and the agent is '{agent}': "
                "leave it out"
            )


def agent_driver(chosen: Agent | NamedAgent) -> Driver:
    """An agent that is asked."""
    from asia.agents import NamedAgent, settings_of
    from asia.search import search

    if not isinstance(chosen, NamedAgent):
        chosen = NamedAgent(chosen, settings_of(chosen))
    return Driver(
        chosen.agent.name,
        lambda ready, on_event, on_start: search(ready, chosen.agent, on_event, on_start),
        dict(chosen.settings),
    )
