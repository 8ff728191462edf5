"""Findings as tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence

from asia.redteam._suite import RedTeamReport
from asia.redteam._types import ANY_LEVEL, Attack, Finding, HonestFinding, SuspicionFinding
from asia.redteam.outside.without_isolation import OFF


def report_table(report: RedTeamReport) -> str:
    """Format the report in Markdown, one row per attack, one column per level.

    Attacks that run once, independent of the level, are in the first column.
    """
    levels = [*map(str, report.plan.levels), *([OFF] if report.plan.prove else [])]
    found = {(f.number, f.level): f for f in report.findings}
    rows = [["#", "attack", *levels]]
    for attack in report.plan.attacks:
        cells = [_cell_text(found.get((attack.number, level))) for level in levels]
        played = found.get((attack.number, ANY_LEVEL))
        if played is not None:
            cells[0] = f"{ANY_LEVEL}: {_cell_text(played)}"
        rows.append([str(attack.number), attack.name, *cells])
    return _aligned(rows)


def without_table(findings: Sequence[Finding], attacks: Sequence[Attack]) -> str:
    """Format the findings without layers in Markdown, by level and layers left out."""
    names = {attack.number: attack.name for attack in attacks}
    rows = [["level", "without", "comes back"]]
    for key in sorted(dict.fromkeys((f.level, f.without) for f in findings), reverse=True):
        back = sorted(f.number for f in findings if (f.level, f.without) == key and f.through)
        words = "; ".join(f"{number} {names[number]}" for number in back)
        rows.append([key[0], ", ".join(key[1]), words or "nothing"])
    return _aligned(rows)


def unchecked_table(findings: Sequence[SuspicionFinding]) -> str:
    """V of each variant with and without the relations that were left out, in Markdown."""
    rows = [["#", "variant", "level", "honest V", "without", "V", "with all checks"]]
    for one in findings:
        value = "no score" if one.value is None else f"{one.value:.3g}"
        value += "" if one.succeeded else " (DOES NOT SUCCEED)"
        without = ", ".join(one.without)
        note = one.checked.note.removeprefix(f"{one.variant}: ")
        ended = f"{_word(one.checked)}: {note}"
        head = [str(one.number), one.variant, one.level, f"{one.honest:.3g}"]
        rows.append([*head, without, value, ended])
    return _aligned(rows)


def summary(report: RedTeamReport, seconds: float) -> str:
    """The last line."""
    count = len(report.plan.attacks)
    parts = [f"{report.stopped} of {count} blocked or flagged"] if count else []
    if report.honest:
        alarms = _counted(report.false_alarms, "false alarm")
        families = _counted(len({one.family for one in report.honest}), "family", "families")
        candidates = _counted(len(report.honest), "honest candidate")
        parts.append(f"{alarms} over {families} ({candidates})")
        missed = [f"{one.family}, {one.failure}" for one in report.unchecked]
        parts += [f"{len(missed)} not checked: {'; '.join(missed)}"] if missed else []
    if report.plan.prove:
        which = f" (not {', '.join(map(str, report.unproven))})" if report.unproven else ""
        parts.append(f"{report.proven} of {count} succeed with isolation off{which}")
    return ", ".join(parts) + f" ({seconds:.0f} s)"


def line(result: Finding | HonestFinding | SuspicionFinding, names: dict[int, str]) -> str:
    """Progress."""
    if isinstance(result, SuspicionFinding):
        words = "succeeds" if result.succeeded else "DOES NOT SUCCEED"
        head = f"{result.number:>2} {names[result.number]}, {result.variant}, {result.level}"
        return f"{head} without {', '.join(result.without)}: {words}; {_word(result.checked)}"
    if isinstance(result, HonestFinding):
        words = "FLAGGED" if result.flagged else "not flagged"
        words = words if result.failure is None else "NOT CHECKED"
        more = f": {result.words}" if result.words else ""
        return f"honest {result.family} on {result.problem}: {words}{more}"
    without = f" without {', '.join(result.without)}" if result.without else ""
    head = f"{result.number:>2} {names[result.number]}, {result.level}{without}: "
    stops = f" by {', '.join(result.stops)}" if result.stops else ""
    note = f" ({result.note})" if result.note else ""
    return head + _word(result) + stops + note


def _counted(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _word(finding: Finding) -> str:
    if finding.level == OFF:
        return "succeeds" if finding.through else "DOES NOT SUCCEED"
    return "THROUGH" if finding.through else finding.verdict.value


def _cell_text(finding: Finding | None) -> str:
    if finding is None:
        return ""
    stops = f": {', '.join(finding.stops)}" if finding.stops and finding.level != OFF else ""
    return _word(finding) + stops


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)
