"""Whether several experiments may be in flight."""

from __future__ import annotations

from asia.agents import Agent, RelayAgent, proposes_ahead
from asia.errors import UserError


def check_parallel(parallel: int, *, strict: bool) -> None:
    """Raises UserError for no experiment at all, or for several where no two workers may run at
    once."""
    if parallel < 1:
        raise UserError(f"--parallel {parallel}: at least 1 experiment is in flight")
    if parallel > 1 and strict:
        raise UserError(
            f"--parallel {parallel} with --isolation-strict: strict isolation lets no two workers "
            "run at once; leave one of the two out"
        )


def check_ahead(parallel: int, agent: Agent) -> None:
    """Raises UserError where an agent is to be asked ahead of results, and does not look at what
    runs."""
    if parallel == 1 or proposes_ahead(agent):
        return
    agents = [r.agent for r in agent.runners] if isinstance(agent, RelayAgent) else [agent]
    name = next(each.name for each in agents if not proposes_ahead(each))
    raise UserError(
        f"--parallel {parallel}: the agent {name} proposes one experiment at a time, from the "
        "result of the one before; leave --parallel out. An agent of your own that reads "
        "view.running says so with proposes_ahead = True"
    )
