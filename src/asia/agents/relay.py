"""A relay: several agents in one search, each from the record of those before it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from asia.agents.view import Agent, AgentView, Proposal, proposes_ahead, settings_of
from asia.errors import UserError
from asia.ledger.events import Leg


@dataclass(frozen=True)
class LegPlan:
    """Leg of a relay as the user requests it."""

    agent: str
    experiments: int | None
    """Number of experiments; None for all remaining ones."""


@dataclass(frozen=True)
class Runner:
    """The agent of a leg."""

    agent: Agent
    leg: Leg


class RelayAgent:
    """Asks the agent whose turn it is. The search hands over, and knows whose turn it is."""

    def __init__(self, runners: Sequence[Runner]) -> None:
        """Raise UserError where one agent follows itself."""
        self.runners = tuple(runners)
        check_legs([runner.leg for runner in self.runners])

    @property
    def name(self) -> str:
        """Name of the relay, as `relay_name`."""
        return relay_name(self.legs)

    @property
    def legs(self) -> tuple[Leg, ...]:
        """Legs for the ledger."""
        return tuple(runner.leg for runner in self.runners)

    @property
    def proposes_ahead(self) -> bool:
        """Whether all of them may be asked while their proposals run."""
        return all(proposes_ahead(runner.agent) for runner in self.runners)

    def propose(self, view: AgentView) -> Proposal | None:
        """Propose a candidate with the agent of the view's leg."""
        return self.runners[view.leg - 1].agent.propose(view)


def relay_name(legs: Sequence[Leg]) -> str:
    """`expert5+bayes`: the names and numbers of all. The last number is left out, so that a larger
    budget is the same relay."""
    return "+".join([*(f"{leg.agent}{leg.experiments}" for leg in legs[:-1]), legs[-1].agent])


def legs_of(agent: object) -> tuple[Leg, ...]:
    """The legs of a relay; () for any other agent."""
    return agent.legs if isinstance(agent, RelayAgent) else ()


def agent_of_leg(agent: Agent, leg: int) -> Agent:
    """Return the agent of a leg; the agent itself where it is no relay."""
    return agent.runners[leg - 1].agent if isinstance(agent, RelayAgent) else agent


def make_runner(agent: Agent, experiments: int | None) -> Runner:
    """A leg of an agent with the settings that it has itself."""
    return Runner(agent, Leg(agent.name, experiments, settings_of(agent)))


def is_relay(text: str) -> bool:
    """Return whether it asks for a relay: legs with `,` or `+` between them, or a number behind
    `*`."""
    return any(sign in text for sign in "*,+")


def read_relay(text: str) -> tuple[LegPlan, ...]:
    """Parse `expert*8,bayes` or `expert*8+bayes` into legs. Raises UserError for an invalid
    relay."""
    plans: list[LegPlan] = []
    for part in re.split(r"[,+]", text):
        found = re.fullmatch(r"(?P<name>.+?)(?:\*(?P<count>.*))?", part.strip())
        if found is None:
            raise UserError(f"--agent {text}: expected agents with a comma between them")
        count = found["count"]
        if count is not None and not (count.isdecimal() and int(count) > 0):
            raise UserError(
                f"--agent {text}: '{part.strip()}': expected a number of experiments after the *, "
                "such as expert*8"
            )
        plans.append(LegPlan(found["name"], None if count is None else int(count)))
    for plan in plans[:-1]:
        if plan.experiments is None:
            raise UserError(
                f"--agent {text}: how many experiments has {plan.agent}? Write {plan.agent}*N; "
                "only the last agent may go without, and takes all that are left"
            )
    return tuple(plans)


def relay_budget(legs: Sequence[LegPlan | Leg]) -> int | None:
    """Return the experiments of all legs; None where the last takes all remaining ones."""
    counts = [leg.experiments for leg in legs]
    return None if None in counts else sum(count for count in counts if count is not None)


def check_relay_budget(legs: Sequence[LegPlan | Leg], budget: int) -> None:
    """Raise UserError unless the legs fit into the budget of the search."""
    asked = sum(leg.experiments or 0 for leg in legs)
    rest = legs[-1].experiments is None
    sums = " + ".join(f"{leg.agent}*{leg.experiments}" for leg in legs if leg.experiments)
    if asked > budget or (rest and asked == budget):
        least = asked + rest
        raise UserError(
            f"the legs of the relay have {sums} = {asked} experiments"
            + (f", {legs[-1].agent} needs one more" if rest else "")
            + f", and the search has {budget}: ask for --experiments {least}, or for fewer in a leg"
        )
    if asked < budget and not rest:
        raise UserError(
            f"the legs of the relay have {sums} = {asked} experiments, and the search has "
            f"{budget}: ask for --experiments {asked}, or leave out the number of the last leg, "
            f"{legs[-1].agent}, which then takes all that are left"
        )


def check_legs(legs: Sequence[Leg]) -> None:
    """Raise UserError where one agent follows itself."""
    for one, other in pairwise(legs):
        if (one.agent, one.settings) == (other.agent, other.settings):
            raise UserError(f"a relay in which {one.agent} follows itself: join its two legs")
