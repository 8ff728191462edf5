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
        raise UserError(f"--parallel {parallel}: at least 1 experiment is in flight")
    if parallel > 1 and strict:
        raise UserError(
            f"--parallel {parallel} with --isolation-strict: strict isolation lets no two workers "
            "run at once; leave one of the two out"
        )


def check_stop_folds(rule: ProtocolRule) -> None:
    """Raises UserError where a sum over some folds says nothing about V, or where to pass over
    folds would tell a candidate or an agent something."""
    metric = find_metric(rule.metric)
    if metric.direction != "lower" or metric.best != 0.0:
        raise UserError(
            f"--stop-folds with the metric {metric.name}: the folds that are left give no bound on "
            "V; leave it out, or use a metric that is 0 at best and never negative, such as rmse"
        )
    if rule.early_stopping != "inner" or rule.ladder is not None:
        what = "a ladder" if rule.ladder is not None else "validation early stopping"
        raise UserError(
            f"--stop-folds with {what}: V of every candidate must be counted there; leave it out"
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
