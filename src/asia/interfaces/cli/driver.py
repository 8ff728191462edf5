"""Agents as the run command starts them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia.agents.registry import NamedAgent
    from asia.agents.relay import LegPlan
    from asia.agents.view import Agent
    from asia.judge.executors import Executor
    from asia.ledger.events import Leg
    from asia.ledger.view import SearchView
    from asia.search.loop import OnEvent
    from asia.search.run import Prepared


@dataclass(frozen=True)
class Driver:
    """Name, factory and settings of an agent."""

    name: str
    """The agent's name, part of the run's name."""
    make: Callable[[Prepared, int], Agent]
    """Makes the agent for a search: in a leg of a relay, or alone with 0."""
    settings: dict[str, str] = field(default_factory=dict[str, str])
    """Settings of the agent that the ledger records; no keys."""
    words: tuple[str, ...] = ()
    """Lines that are printed before the search."""
    legs: tuple[Leg, ...] = ()
    """The legs of a relay, the last one with the requested number of experiments."""

    def search(
        self,
        ready: Prepared,
        on_event: OnEvent,
        on_start: Callable[[SearchView], None],
        executor: Executor,
    ) -> SearchView:
        """Run the search, then end the processes that the agent started."""
        from asia.agents.relay import RelayAgent
        from asia.interfaces.coding_agents.session import CommandAgent, search_with_agents

        agent = self.make(ready, 0)
        agents = [r.agent for r in agent.runners] if isinstance(agent, RelayAgent) else [agent]
        processes = [each for each in agents if isinstance(each, CommandAgent)]
        return search_with_agents(ready, agent, processes, on_event, on_start, executor)


def named_agent(name: str, space: str | None) -> NamedAgent:
    """Return the agent as `choose_agent` does. Raises UserError for a coding agent without
    `command:`."""
    from asia.agents.registry import choose_agent
    from asia.errors import UserError
    from asia.interfaces.coding_agents.presets import PRESETS

    if name in PRESETS:
        raise UserError(f"--agent {name}: write command:{name}, as for every coding agent")
    return choose_agent(name, space)


def refuse_for_others(agents: Sequence[str], *, owners: Sequence[str], **given: object) -> None:
    """Raise UserError if an option of some agents was given to others."""
    from asia.errors import UserError

    kinds = [agent.partition(":")[0] for agent in agents]
    whose = " or ".join("command:NAME" if o == "command" else o for o in owners)
    for name, value in given.items():
        if not set(kinds) & set(owners) and value is not None:
            raise UserError(
                f"--{name.replace('_', '-')} is for --agent {whose}, and the agent is "
                f"'{', '.join(agents)}': leave it out"
            )


def agent_driver(chosen: Agent | NamedAgent) -> Driver:
    """Return the driver of an agent with `propose`."""
    from asia.agents.registry import NamedAgent
    from asia.agents.view import settings_of

    if not isinstance(chosen, NamedAgent):
        chosen = NamedAgent(chosen, settings_of(chosen))
    return Driver(chosen.agent.name, lambda ready, leg: chosen.agent, dict(chosen.settings))


def relay_driver(plans: Sequence[LegPlan], drivers: Sequence[Driver]) -> Driver:
    """Return the driver of a relay of agents. Raises UserError as `RelayAgent` does."""
    from asia.agents.relay import RelayAgent, Runner, check_legs, relay_name
    from asia.ledger.events import Leg

    pairs = zip(plans, drivers, strict=True)
    legs = tuple(Leg(d.name, plan.experiments, d.settings) for plan, d in pairs)
    check_legs(legs)

    def make(ready: Prepared, leg: int) -> Agent:
        del leg
        made = [driver.make(ready, place) for place, driver in enumerate(drivers, 1)]
        return RelayAgent([Runner(a, each) for a, each in zip(made, legs, strict=True)])

    words = tuple(word for driver in drivers for word in driver.words)
    return Driver(relay_name(legs), make, words=words, legs=legs)
