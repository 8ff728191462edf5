"""What proposes, as the run command sees it."""

from __future__ import annotations

from collections.abc import Callable
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
    """As `make_agent`."""
    from asia.agents import make_agent

    return make_agent(name, space)


def agent_driver(agent: Agent) -> Driver:
    """An agent that is asked."""
    from asia.agents import settings_of
    from asia.search import search

    return Driver(
        agent.name,
        lambda ready, on_event, on_start: search(ready, agent, on_event, on_start),
        settings_of(agent),
    )
