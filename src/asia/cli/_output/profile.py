"""Time of a search by activity, as a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from asia._stopwatch import Activity, Seconds, TimeSpent, add_seconds
from asia.ledger import Evaluated, Event, GuardLooked, Refitted

ABSENT = "not recorded"
_NOT_IN_LEDGER = (Activity.PREPARE, Activity.PICTURES)


def summed(events: Iterable[Event], beside: Sequence[TimeSpent] = ()) -> tuple[TimeSpent, ...]:
    """Sum the seconds of each activity over all events. beside: seconds that the ledger does not
    record."""
    spent: Seconds = {}
    recorded = [e.spent for e in events if isinstance(e, Evaluated | Refitted | GuardLooked)]
    for one in (one for parts in (*recorded, beside) for one in parts):
        add_seconds(spent, one.activity, one.wall, one.processor)
    return tuple(TimeSpent(one, *spent[one]) for one in Activity if one in spent)


def profile_lines(events: Sequence[Event], beside: Sequence[TimeSpent] = ()) -> list[str]:
    """Return the table: one line per activity, the total last."""
    results = [e for e in events if isinstance(e, Evaluated)]
    without = sum(not e.spent for e in results)
    spent = summed(events, beside)
    if without == len(results):
        return [f"profile  {ABSENT}: no experiment of this run has a profile"]
    total = sum(one.wall for one in spent)
    lines = [f"profile  {'wall s':>22} {'share':>7} {'processor s':>12}"]
    for one in spent:
        share = f"{100 * one.wall / total:.1f} %"
        lines.append(f"  {one.activity:<12} {one.wall:16.2f} {share:>7} {one.processor:12.2f}")
    known = {one.activity for one in spent}
    lines += [f"  {a:<12} {ABSENT:>16}" for a in _NOT_IN_LEDGER if a not in known]
    processor = sum(one.processor for one in spent)
    lines.append(f"  {'total':<12} {total:16.2f} {'':>7} {processor:12.2f}")
    if without:
        lines.append(f"  {without} of {len(results)} experiments: {ABSENT}")
    return lines


def profile_object(
    events: Sequence[Event], beside: Sequence[TimeSpent] = ()
) -> dict[str, dict[str, float]]:
    """Return the seconds by activity."""
    return {
        one.activity.value: {"wall": one.wall, "processor": one.processor}
        for one in summed(events, beside)
    }
