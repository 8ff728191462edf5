"""What proposes, as the run command sees it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia.agents import Agent
    from asia.ledger import SearchView
    from asia.search import OnEvent, Prepared

    Search = Callable[[Prepared, OnEvent, Callable[[SearchView], None]], SearchView]


@dataclass(frozen=True)
class Driver:
    """name: in the run's name; search: runs it; settings: recorded, no keys among them; words: said
    to the person beforehand."""

    name: str
    search: Search
    settings: dict[str, str] = field(default_factory=dict[str, str])
    words: tuple[str, ...] = ()


def built_in(name: str, space: str | None) -> Agent:
    """As `make_agent`; who names a coding agent is told how to call it."""
    from asia.agents import make_agent
    from asia.drive.command import PRESETS
    from asia.errors import UserError

    if name in PRESETS:
        raise UserError(f"--agent {name}: write command:{name}, as for every coding agent")
    return make_agent(name, space)


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


def agent_driver(agent: Agent) -> Driver:
    """An agent that is asked."""
    from asia.agents import settings_of
    from asia.search import search

    return Driver(
        agent.name,
        lambda ready, on_event, on_start: search(ready, agent, on_event, on_start),
        settings_of(agent),
    )
