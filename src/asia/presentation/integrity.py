"""Integrity of a search: isolation, what saw held-out data, guard records, sealed test, cost."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from asia._text import one_line
from asia.ledger.events import Started, Usage
from asia.ledger.looks import copy_words, look_by_copy
from asia.ledger.view import SearchView
from asia.presentation.experiments import value_text
from asia.presentation.table import Table


def integrity_facts(directory: Path, view: SearchView) -> Iterator[tuple[str, str]]:
    """Yield what a reader has to know to trust the result of a search; labels with texts."""
    start = view.started
    yield "isolation", isolation_text(start)
    if start.isolation_notes:
        yield "missing protection", "; ".join(start.isolation_notes)
    yield "sealed test", sealed_test_text(directory, view)
    none = "none: candidates hold out parts of their own training data"
    yield "held-out data shown", "; ".join(v_notes(view)) or none
    yield "guard records", guard_text(view) or "none"
    yield "language model", usage_text(view.usage) if view.usage else "none used"
    yield from (("note of the user", note.text) for note in view.notes)
    yield from (("failed diagnostic", line) for line in view.failed_checks)


def isolation_text(start: Started) -> str:
    """`namespace, strict (mount, network)`."""
    return start.isolation_words + (f" ({', '.join(start.layers)})" if start.layers else "")


def v_notes(view: SearchView, scores: int | None = None) -> Iterator[str]:
    """Yield what V of a search is, where candidates or the agent learned of held-out data. scores:
    validation scores that were given; None for those in the view."""
    if view.started.early_stopping == "validation":
        yield (
            "with validation early stopping: candidates may request their score on the held-out "
            "parts, so V is not leak-free and only comparable with V of the same setting; "
            f"{view.validation_scores if scores is None else scores} validation scores were given"
        )
    if view.started.residuals == "held_out":
        yield (
            "with held-out residuals: held-out residuals are shown to the agent, which can fit a "
            "model to them, so V is only comparable with V of the same setting"
        )


def guard_text(view: SearchView) -> str:
    """Describe the last look at the guard: `#07 0.2310, #09 0.2280; it picks #09, ...`, and how
    often the agent learned an answer of it; "" without guard records."""
    if view.started.guard_digest is None:
        return ""
    asked = f"asked for {view.guard_bits} new bests, at most {view.guard_bits} bits for the agent"
    if not view.looks:
        return f"not looked at yet; {asked}"
    look, best = view.looks[-1], view.best
    scores = ", ".join(f"#{s.experiment:02d} {value_text(s.outcome)}" for s in look.scores)
    pick = "none" if look.pick is None else f"#{look.pick:02d}"
    handed = ""
    if best is not None and best.number != look.pick:
        handed = f", the best candidate is #{best.number:02d}"
    return f"{scores}; it picks {pick}{handed} (look {look.look}; {asked})"


def guard_table(view: SearchView) -> Table:
    """Return the errors on the guard records of each look."""
    rows = [
        (one.look, score.experiment, value_text(score.outcome))
        for one in view.looks
        for score in one.scores
    ]
    columns = {"look": "", "experiment": "number", "error": "error"}
    return Table("looks at the guard records", columns, rows)


def sealed_test_text(directory: Path, view: SearchView) -> str:
    """Describe the sealed test of a search: whether there is one, its digest and its looks."""
    digest = view.started.test_digest
    if digest is None:
        return "none"
    parts = [seal_text(directory, view)]
    if view.unsealing is not None or view.unsealed is not None:
        parts.insert(0, "opened by this run once, after the search")
    if view.unsealing is not None and view.unsealing.process_consent:
        parts.append("the user agreed to open it, although candidates could have read it")
    parts = [*filter(None, parts)] or ["never opened"]
    return "; ".join([*parts, f"SHA-256 {digest[:16]}, recorded before the first experiment"])


def seal_text(directory: Path, view: SearchView) -> str:
    """Describe a look at the test that the ledger of the search does not have, or that is not the
    first one; "" for a first look, or none."""
    if (copy := look_by_copy(directory, view)) is not None:
        return copy_words(view.started.run, copy)
    return "" if view.unsealing is None else later_text(view.unsealing.opened_before)


def later_text(before: Sequence[str]) -> str:
    """Give the number of a look at test records, and the looks before; "" for the first one."""
    if not before:
        return ""
    return f"look {len(before) + 1} at these test records, after {one_line('; '.join(before), 600)}"


def usage_text(usage: Usage) -> str:
    """`12 replies, 40310 tokens in (1200 cached), 8120 out, 0.0231 USD`."""
    cost = "cost unknown" if usage.cost is None else f"{usage.cost:.4f} USD"
    return (
        f"{usage.turns} replies, {usage.input_tokens} tokens in ({usage.cached_tokens} cached), "
        f"{usage.output_tokens} out, {cost}"
    )
