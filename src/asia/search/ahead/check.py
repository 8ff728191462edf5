"""Check of the options for concurrent experiments and pruned folds."""

from __future__ import annotations

from asia.agents import Agent, RelayAgent, proposes_ahead
from asia.errors import UserError
from asia.protocol import ProtocolRule, find_metric


def check_ways(rule: ProtocolRule, parallel: int, *, strict: bool, stop_folds: bool) -> None:
    """Raises UserError where candidates cannot be evaluated in the ways that were asked for."""
    check_parallel(parallel, strict=strict)
    if stop_folds:
        check_stop_folds(rule)


def check_parallel(parallel: int, *, strict: bool) -> None:
    """Raises UserError for no experiment at all, or for several where no two workers may run at
    once."""
    if parallel < 1:
        raise UserError(f"--parallel {parallel}: expected at least 1")
    if parallel > 1 and strict:
        raise UserError(
            f"--parallel {parallel} with --isolation-strict: strict isolation runs the workers "
            f"sequentially; omit one of the two"
        )


def check_stop_folds(rule: ProtocolRule) -> None:
    """Raises UserError where a sum over some folds says nothing about V, or where to pass over
    folds would tell a candidate or an agent something."""
    metric = find_metric(rule.metric)
    if metric.direction != "lower" or metric.best != 0.0:
        raise UserError(
            f"--stop-folds with the metric {metric.name}: the completed folds give no lower bound "
            f"on V; omit it, or use a metric that is never negative and 0 at best, such as rmse"
        )
    if rule.early_stopping != "inner" or rule.ladder is not None:
        what = "a ladder" if rule.ladder is not None else "validation early stopping"
        raise UserError(f"--stop-folds with {what}: V of every candidate is needed there; omit it")


def check_ahead(parallel: int, agent: Agent) -> None:
    """Raises UserError where an agent is to be asked ahead of results, and does not look at what
    runs."""
    if parallel == 1 or proposes_ahead(agent):
        return
    agents = [r.agent for r in agent.runners] if isinstance(agent, RelayAgent) else [agent]
    name = next(each.name for each in agents if not proposes_ahead(each))
    raise UserError(
        f"--parallel {parallel}: the agent {name} proposes one experiment at a time, from the "
        f"result of the one before; omit --parallel. An agent of your own that reads "
        "view.running says so with proposes_ahead = True"
    )
