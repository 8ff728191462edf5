"""`[protocol]` of a problem file: its tables, their checks, and conversion to and from a rule.

The digest of a protocol covers every field of its rule, so that the rule has no room for words of
the file alone (a fold count that may be left out): these are in the tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from asia._text import suggestion
from asia.errors import UserError
from asia.problem.metrics import known_metric, known_test_metric, listed_metrics
from asia.problem.protocol import (
    EarlyStopping,
    FoldKind,
    FoldRule,
    Group,
    OutputGroup,
    ProtocolRule,
    ShownResidual,
    TestRule,
)

GroupsTable = Mapping[str, Sequence[str]]
Names = Annotated[tuple[str, ...], Field(min_length=1)]
_PastSamples = Annotated[int, Field(ge=0, le=100_000)]


@dataclass(frozen=True)
class FoldsTable:
    kind: FoldKind = "contiguous"
    count: Annotated[int, Field(ge=1, le=100)] | None = None
    gap: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    tail: Annotated[int, Field(ge=1, le=100_000_000)] | None = None
    period: Annotated[int, Field(ge=2, le=100_000_000)] | None = None

    def rule(self) -> FoldRule:
        """Return the fold rule without its groups, which are known once the records were read."""
        if self.kind == "leave_one_group_out":
            return FoldRule(self.kind, 0)
        count = FoldRule.count if self.count is None else self.count
        return FoldRule(self.kind, count, gap=self.gap or None, tail=self.tail, period=self.period)


@dataclass(frozen=True)
class RotationTable:
    """Outputs that are angles of one rotation."""

    roll_pitch_yaw: Annotated[tuple[str, ...], Field(min_length=3, max_length=3)]


@dataclass(frozen=True)
class TestTable:
    metrics: Annotated[
        tuple[Annotated[str, AfterValidator(known_test_metric)], ...], Field(min_length=1)
    ] = ("rmse",)
    skip: Annotated[int, Field(ge=0)] = 0
    groups: Mapping[str, Names | RotationTable] = field(
        default_factory=dict[str, "Names | RotationTable"]
    )
    horizons: tuple[Annotated[int, Field(ge=1)], ...] = ()
    unit: Annotated[str, Field(min_length=1)] | None = None
    unit_factor: Annotated[float, Field(gt=0)] | None = None
    figures: Mapping[str, Names] = field(default_factory=dict[str, Names])

    def rule(self) -> TestRule:
        groups = tuple(
            OutputGroup(name, entry.roll_pitch_yaw, "geodesic")
            if isinstance(entry, RotationTable)
            else OutputGroup(name, entry)
            for name, entry in self.groups.items()
        )
        figures = tuple(Group(name, records) for name, records in self.figures.items())
        return TestRule(
            self.metrics, self.skip, groups, self.horizons, self.unit, self.unit_factor, figures
        )


@dataclass(frozen=True)
class ProtocolTable:
    kind: Literal["simulation", "windows", "control"] = "simulation"
    folds: FoldsTable = FoldsTable()
    past_inputs: _PastSamples = ProtocolRule.past_inputs
    past_outputs: _PastSamples = ProtocolRule.past_outputs
    metric: Annotated[str, AfterValidator(known_metric)] = "rmse"
    early_stopping: EarlyStopping = "inner"
    horizon: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    test: TestTable = TestTable()
    residuals: ShownResidual = "train"

    def rule(self) -> ProtocolRule:
        return ProtocolRule(
            kind=self.kind,
            folds=self.folds.rule(),
            past_inputs=self.past_inputs,
            past_outputs=self.past_outputs,
            metric=self.metric,
            early_stopping=self.early_stopping,
            horizon=self.horizon,
            test=self.test.rule(),
            residuals=self.residuals,
        )


def check_protocol(table: ProtocolTable, groups: GroupsTable, outputs: Sequence[str]) -> None:
    """Raise UserError at the first setting that another one rules out or needs."""
    if table.kind == "windows" and table.horizon is None:
        raise UserError(
            'protocol.kind = "windows" needs protocol.horizon, the samples simulated in each '
            "window: add one, such as horizon = 50"
        )
    if table.kind != "windows" and table.horizon is not None:
        raise UserError(
            'protocol.horizon belongs to kind = "windows": set that, or leave the horizon out to '
            "simulate whole blocks"
        )
    folds = table.folds
    if (folds.kind == "tail") != (folds.tail is not None):
        raise UserError(
            'protocol.folds.tail, the samples at the end of each record, and kind = "tail" belong '
            'together: write folds = { kind = "tail", tail = 100, count = 2 }, or neither'
        )
    if folds.period is not None and folds.kind != "contiguous":
        raise UserError(
            'protocol.folds.period belongs to kind = "contiguous": set that, or leave the period '
            "out"
        )
    if folds.count == 1 and folds.kind != "tail":
        raise UserError(
            'protocol.folds.count is 1, which only folds of kind = "tail" can have: use 2 or more'
        )
    if folds.kind == "leave_one_group_out":
        if folds.count is not None:
            raise UserError(
                "protocol.folds.count belongs to contiguous folds: leave it out, [data.groups] "
                "says how many there are"
            )
        if folds.gap:
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
    _check_test(table, table.test.rule(), outputs)


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
            'protocol.test.metrics names "mee" alone, which is a table: add a metric that is one '
            f"number, such as {listed_metrics()}"
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
    found: list[Group] = []
    for group, patterns in groups.items():
        inside: set[str] = set()
        for pattern in patterns:
            matching = [n for n in names if fnmatchcase(n, pattern)]
            if pattern in names:
                matching = [pattern]
            if not matching:
                known = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
                raise UserError(
                    f"[data.groups] {group}: no training record is called '{pattern}'"
                    f"{suggestion(pattern, names)} (they are {known})"
                )
            inside.update(matching)
        if not inside:
            raise UserError(f"[data.groups] {group} is empty: name its records, or leave it out")
        found.append(Group(group, tuple(n for n in names if n in inside)))
    for record in names:
        owners = [group.name for group in found if record in group.records]
        if len(owners) != 1:
            where = f"in groups {' and '.join(owners)}" if owners else "in no group"
            raise UserError(
                f"[data.groups]: training record '{record}' is {where}, expected exactly one: "
                "correct the names or wildcards"
            )
    return replace(rule, folds=replace(rule.folds, count=len(found), groups=tuple(found)))


def groups_table(rule: ProtocolRule) -> dict[str, list[str]] | None:
    """[data.groups] of a rule; None without groups."""
    return {g.name: list(g.records) for g in rule.folds.groups} or None


def protocol_table(rule: ProtocolRule) -> dict[str, Any]:
    """[protocol] of a rule, from which `ProtocolTable` reads the same rule, its groups apart."""
    grouped = rule.folds.kind == "leave_one_group_out"
    test = rule.test
    return {
        **{k: value for k, value in asdict(rule).items() if k != "tolerance"},
        # Left out where it says nothing new, as in locks written before there was a choice.
        "residuals": rule.residuals if rule.residuals != ProtocolRule.residuals else None,
        "folds": {
            "kind": rule.folds.kind,
            "count": None if grouped else rule.folds.count,
            "gap": rule.folds.gap,
            "tail": rule.folds.tail,
            "period": rule.folds.period,
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
