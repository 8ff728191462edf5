"""Consistency checks of a protocol, and its conversion to and from tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from fnmatch import fnmatchcase
from typing import Any

from asia._text import suggestion
from asia.errors import UserError
from asia.problem.protocol import Group, ProtocolRule, TestRule
from asia.problem.schema import ProtocolTable

GroupsTable = Mapping[str, Sequence[str]]


def check_protocol(table: ProtocolTable, groups: GroupsTable, outputs: Sequence[str]) -> None:
    """Raise UserError at the first setting that another one rules out or needs."""
    if table.kind == "windows" and table.horizon is None:
        raise UserError(
            'protocol.kind = "windows" needs protocol.horizon, the samples simulated in each '
            "window: add one, such as horizon = 50"
        )
    if table.kind == "simulation" and table.horizon is not None:
        raise UserError(
            'protocol.horizon belongs to kind = "windows": set that, or leave the horizon out to '
            "simulate whole blocks"
        )
    _check_tail(table)
    if table.folds.kind == "leave_one_group_out":
        if table.folds.count is not None:
            raise UserError(
                "protocol.folds.count belongs to contiguous folds: leave it out, [data.groups] "
                "says how many there are"
            )
        if table.folds.gap:
            raise UserError(
                "protocol.folds.gap belongs to folds within a record: leave it out, "
                "leave_one_group_out holds out whole records"
            )
        if len(groups) < 2:
            raise UserError(
                f"leave_one_group_out needs two groups of records or more, [data.groups] has "
                f'{len(groups)}: add lines such as slow = ["slow_run*"]'
            )
    elif groups:
        raise UserError(
            "[data.groups] belongs to leave_one_group_out folds: set protocol.folds = { kind = "
            '"leave_one_group_out" }, or leave the groups out'
        )
    check_feedback(table.rule())
    if table.ladder_step is not None and table.feedback == "exact":
        raise UserError(
            'protocol.ladder_step belongs to feedback = "ladder": set that, or leave the step out '
            "to report every V to agents"
        )
    _check_test(table, table.test.rule(), outputs)


def _check_tail(table: ProtocolTable) -> None:
    folds = table.folds
    if (folds.kind == "tail") != (folds.tail is not None):
        raise UserError(
            'protocol.folds.tail, the samples at the end of each record, and kind = "tail" belong '
            'together: write folds = { kind = "tail", tail = 100, count = 2 }, or neither'
        )
    if folds.count == 1 and folds.kind != "tail":
        raise UserError(
            'protocol.folds.count is 1, which only folds of kind = "tail" can have: use 2 or more'
        )


def check_feedback(rule: ProtocolRule) -> None:
    """Raise UserError when a fit could learn held-out data through the agent's feedback."""
    if rule.ladder is not None and rule.early_stopping == "validation":
        raise UserError(
            'protocol.feedback = "ladder" hides V from the agent, but early_stopping = '
            '"validation" reports it to candidates: keep one of them'
        )
    if rule.ladder is not None and rule.residuals == "held_out":
        raise UserError(
            'protocol.feedback = "ladder" hides V from the agent, but residuals = "held_out" shows '
            "it where each held-out sample is missed: keep one of them"
        )


def _check_test(table: ProtocolTable, test: TestRule, outputs: Sequence[str]) -> None:
    if test.unit_factor is not None and test.unit is None:
        raise UserError(
            "protocol.test.unit_factor belongs to protocol.test.unit: say which unit it leads to, "
            'such as unit = "mV"'
        )
    if table.kind == "windows" and test.skip:
        raise UserError(
            "protocol.test.skip leaves out the start of a long simulation, but every sample of a "
            'window counts: remove protocol.test.skip, or kind = "windows"'
        )
    if "mee" not in test.metrics:
        if test.groups or test.horizons:
            raise UserError(
                "protocol.test has groups or horizons, which belong to the Mean Euclidean Error: "
                'add "mee" to protocol.test.metrics, or leave them out'
            )
        return
    if table.horizon is None:
        raise UserError(
            'protocol.test.metrics names "mee", the error at each step of a window: it needs '
            'protocol.kind = "windows"; leave it out for long simulations'
        )
    if set(test.metrics) == {"mee"}:
        raise UserError(
            'protocol.test.metrics names "mee" alone, which is a table: add "rmse" or "mae", which '
            "is one number"
        )
    if not test.groups:
        raise UserError(
            'protocol.test.metrics names "mee": say which outputs belong together, such as '
            '[protocol.test.groups] position = ["x", "y"]'
        )
    for group in test.groups:
        for name in group.outputs:
            if name not in outputs:
                raise UserError(
                    f"[protocol.test.groups] {group.name}: there is no output '{name}'"
                    f"{suggestion(name, outputs)}"
                )
    for step in test.horizons:
        if step > table.horizon:
            raise UserError(
                f"protocol.test.horizons names {step}, but a window has {table.horizon} samples: "
                "name steps within protocol.horizon"
            )


def with_groups(rule: ProtocolRule, groups: GroupsTable, names: Sequence[str]) -> ProtocolRule:
    """The rule with its groups of records.

    A pattern is a record's name, or else a wildcard (`*`, `?`, `[...]`).

    Raises:
        UserError: unless each record is in exactly one group
    """
    if rule.folds.kind != "leave_one_group_out":
        return rule
    found = tuple(
        Group(name, tuple(n for n in names if any(_matches(n, p, names) for p in patterns)))
        for name, patterns in groups.items()
    )
    for (name, patterns), group in zip(groups.items(), found, strict=True):
        for pattern in patterns:
            if not any(_matches(n, pattern, names) for n in names):
                raise UserError(
                    f"[data.groups] {name}: no training record is called '{pattern}'"
                    f"{suggestion(pattern, names)} (they are {_few(names)})"
                )
        if not group.records:
            raise UserError(f"[data.groups] {name} is empty: name its records, or leave it out")
    for record in names:
        owners = [group.name for group in found if record in group.records]
        if len(owners) != 1:
            where = f"in groups {' and '.join(owners)}" if owners else "in no group"
            raise UserError(
                f"[data.groups]: training record '{record}' is {where}, expected exactly one: "
                "correct the names or wildcards"
            )
    return replace(rule, folds=replace(rule.folds, count=len(found), groups=found))


def _matches(name: str, pattern: str, names: Sequence[str]) -> bool:
    return name == pattern if pattern in names else fnmatchcase(name, pattern)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")


def groups_table(rule: ProtocolRule) -> dict[str, list[str]] | None:
    """[data.groups] of a rule; None without groups."""
    return {g.name: list(g.records) for g in rule.folds.groups} or None


def protocol_table(rule: ProtocolRule) -> dict[str, Any]:
    """[protocol] of a rule, from which `ProtocolTable` reads the same rule, its groups apart."""
    grouped = rule.folds.kind == "leave_one_group_out"
    test = rule.test
    ladder = rule.ladder
    return {
        **{key: value for key, value in asdict(rule).items() if key != "ladder"},
        "feedback": None if ladder is None else "ladder",
        "ladder_step": ladder,
        # Left out where it says nothing new, as in locks written before there was a choice.
        "residuals": rule.residuals if rule.residuals != ProtocolRule.residuals else None,
        "folds": {
            "kind": rule.folds.kind,
            "count": None if grouped else rule.folds.count,
            "gap": rule.folds.gap,
            "tail": rule.folds.tail,
        },
        "test": {
            "metrics": test.metrics,
            "skip": test.skip,
            "groups": {
                g.name: {"roll_pitch_yaw": g.outputs} if g.distance == "geodesic" else g.outputs
                for g in test.groups
            }
            or None,
            "horizons": test.horizons or None,
            "unit": test.unit,
            "unit_factor": test.unit_factor,
            "figures": {f.name: f.records for f in test.figures} or None,
        },
    }
