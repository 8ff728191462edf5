"""Text that several commands print."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from asia._text import folded, printable
from asia._timer import Activity, Seconds, TimeSpent, add_seconds
from asia.agents.expert_result import expert_result, expert_text
from asia.analysis.verdict import alarms, unguarded, usability
from asia.ledger.events import Evaluated, Event, GuardLooked, Refitted
from asia.ledger.run import model_to_use
from asia.ledger.view import SearchView
from asia.presentation.experiments import method_note, seed_mean_words, threshold_text
from asia.presentation.integrity import guard_text, usage_text, v_notes
from asia.presentation.results import (
    confirmation_verdict,
    noise_text,
    second_fit_text,
    stack_text,
    validation_text,
)
from asia.presentation.table import error_value
from asia.search.steering import FoldLosses


class Terminal(Console):
    """Console that prints text literally and removes its control characters. Only rich itself sets
    colours and moves the cursor."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **settings)

    def print(self, *objects: Any, soft_wrap: bool | None = None, **settings: Any) -> None:
        """Print; on a terminal one line of text is folded as by `asia._text.say`."""
        text = objects[0] if len(objects) == 1 else None
        if isinstance(text, str) and self.is_terminal:
            lines = (folded(line, self.width) for line in text.split("\n"))
            objects, soft_wrap = ("\n".join(lines),), True
        super().print(*objects, soft_wrap=soft_wrap, **settings)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Filter all output, live displays included."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)


def plain(value: Any) -> Any:
    """The same in lists and numbers, with null for what is not finite."""
    if isinstance(value, dict):
        entries: dict[str, Any] = value
        return {name: plain(one) for name, one in entries.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        items: Sequence[Any] = value
        return [plain(one) for one in items]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def running_words(view: SearchView, losses: Mapping[int, FoldLosses] | None = None) -> list[str]:
    """Return `#05 refine: linear, one state more` for each experiment in flight, and whether its
    fit has ended, else the last loss of each fold."""
    found: list[str] = []
    for e in view.running:
        words = f"#{e.number:02d} {e.proposed.phase}: {e.proposed.title}"
        folds = sorted((losses or {}).get(e.number, {}).items())
        if e.landed is not None:
            words += " (fitted, waits for its turn)"
        elif folds:
            each = (f"{c[-1][1]:.4g} at step {c[-1][0]:g} in fold {fold}" for fold, c in folds)
            words += f" (loss {', '.join(each)})"
        found.append(words)
    return found


def print_alarms(view: SearchView) -> None:
    """Print what is said before the result: alarms, in red where the terminal has colours, and
    whether V stands alone."""
    console = Terminal(soft_wrap=True)
    for words in alarms(view):
        console.print(fact_line("ALARM", words), style="bold red")
    if words := unguarded(view):
        console.print(fact_line("NOTE", words), style="bold yellow")


def verdict_object(view: SearchView) -> dict[str, Any] | None:
    """Return the verdict for scripts; None without a model."""
    found = usability(view)
    return None if found is None else asdict(found)


def fact_line(label: str, text: str) -> str:
    """A text behind its label."""
    return f"{label:<8} {text}"


def verdict_facts(view: SearchView) -> Iterator[tuple[str, str]]:
    """Yield the verdict with its reasons, the model to use and the other models; labels with
    texts. Nothing without a model."""
    found, named, refitted = usability(view), model_to_use(view), view.refitted
    if found is None:
        return
    first, *others = found.reasons or ("",)
    yield "verdict", f"{found.kind}: {first}" if first else found.kind
    yield from (("", reason) for reason in others)
    if named is None or refitted is None:
        return
    yield "use", f"{named.model}: {named.reason}"
    if refitted.model is None and refitted.detail and named.model != "ensemble":
        yield "refit", f"none: {refitted.detail}"
    stack, best = refitted.stack, view.best_value
    if stack is not None and best is not None and stack.value < best:
        yield "stack", stack_text(stack, view.v_name)


def search_facts(
    view: SearchView, directory: Path, finished: int, scores: int | None = None
) -> Iterator[tuple[str, str]]:
    """Yield what is known of a search beside its experiments, labels with texts.

    Args:
        finished: number of its experiments with a result
        scores: validation scores that were given; None for those in the view
    """
    if view.stopped is not None:
        words = stop_words(view.stopped.reason, view)
        detail = f" ({view.stopped.detail})" if view.stopped.detail else ""
        yield "stopped", f"{words}{detail if view.stopped.detail not in words else ''}"
    if view.usage is not None:
        yield "agent", usage_text(view.usage)
    best = view.best
    if best is not None and best.score is not None:
        folds = ", ".join(error_value(f.value) for f in best.score.folds)
        mean = f", {words}" if (words := seed_mean_words(best)) else ""
        value = f"V={error_value(best.score.value)} (folds {folds}){mean}"
        yield "best", f"#{best.number:02d} {value}  {best.proposed.title}"
    elif view.complete:
        yield "best", "none: every candidate failed"
    yield from verdict_facts(view)
    yield from (("V is", words) for words in v_notes(view, scores))
    # Evidence for the best candidate other than V.
    again = view.refitted.again if view.refitted else None
    for label, words in (
        ("method", method_note(view)),
        ("threshold", threshold_text(view)),
        ("second fit", second_fit_text(again) if again and again.value != 1.0 else ""),
        ("guard", guard_text(view)),
    ):
        if words:
            yield label, words
    if (found := view.confirmed) is not None:
        noise = f"variance over seeds: {noise_text(found)}"
        yield "confirm", f"{confirmation_verdict(found)}; {noise}"
    yield from (("checks", validation_text(one)) for one in view.validated)
    yield from (("note", line) for line in view.failed_checks)
    compared = expert_result(directory, view.started, finished)
    if compared is not None:
        yield "control", expert_text(compared, view.started)


def stop_words(reason: str, view: SearchView) -> str:
    """Return the stop reason as text; the agent's own text if it found nothing left to try."""
    if reason == "saturated" and view.stopped is not None and view.stopped.detail:
        return f"saturated: {view.stopped.detail}"
    return {
        "budget": f"the budget of {view.budget} experiments is spent (extend: --experiments)",
        "saturated": "saturated: the last experiments found nothing better",
        "exhausted": "the agent has nothing left to try",
        "hours": "the wall-clock budget is spent",
        "user": "on request; the same command continues",
        "stuck": "the agent was stuck; the same command continues",
        "tokens": "the token budget is spent; the same command with more tokens continues",
        "cost": "the money budget is spent; the same command with more continues",
        "time": "the agent's time is spent; the same command with more continues",
        "agent": "the agent ended; the same command starts it again",
    }[reason]


def time_by_activity(
    events: Iterable[Event], unrecorded: Sequence[TimeSpent] = ()
) -> tuple[TimeSpent, ...]:
    """Sum the seconds of each activity over all events. unrecorded: seconds that the ledger does
    not record."""
    spent: Seconds = {}
    recorded = [e.spent for e in events if isinstance(e, Evaluated | Refitted | GuardLooked)]
    for one in (one for parts in (*recorded, unrecorded) for one in parts):
        add_seconds(spent, one.activity, one.wall, one.processor)
    return tuple(TimeSpent(one, *spent[one]) for one in Activity if one in spent)


def profile_lines(events: Sequence[Event], unrecorded: Sequence[TimeSpent] = ()) -> list[str]:
    """Return the table: one line per activity, the total last."""
    results = [e for e in events if isinstance(e, Evaluated)]
    without = sum(not e.spent for e in results)
    if without == len(results):
        return ["profile  not recorded: no experiment of this run has a profile"]
    spent = time_by_activity(events, unrecorded)
    total = sum(one.wall for one in spent)
    lines = [f"profile  {'wall s':>22} {'share':>7} {'processor s':>12}"]
    for one in spent:
        share = f"{100 * one.wall / total:.1f} %"
        lines.append(f"  {one.activity:<12} {one.wall:16.2f} {share:>7} {one.processor:12.2f}")
    known = {one.activity for one in spent}
    not_in_ledger = (Activity.PREPARE, Activity.PICTURES)
    lines += [f"  {a:<12} {'not recorded':>16}" for a in not_in_ledger if a not in known]
    processor = sum(one.processor for one in spent)
    lines.append(f"  {'total':<12} {total:16.2f} {'':>7} {processor:12.2f}")
    if without:
        lines.append(f"  {without} of {len(results)} experiments: not recorded")
    return lines


def profile_object(
    events: Sequence[Event], unrecorded: Sequence[TimeSpent] = ()
) -> dict[str, dict[str, float]]:
    """Return the seconds by activity."""
    return {
        one.activity.value: {"wall": one.wall, "processor": one.processor}
        for one in time_by_activity(events, unrecorded)
    }
