"""results.tsv and search_journal.md, generated from the view."""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path

from asia._text import markdown_line, table_cell
from asia.judge.scoring.outcome import Score
from asia.ledger.chain import write_whole
from asia.ledger.events import HandedOver
from asia.ledger.text import (
    describe_result,
    error_value,
    hand_over_text,
    phase_text,
    seed_mean_words,
)
from asia.ledger.view import Experiment, SearchView


def write_exports(directory: Path, view: SearchView) -> None:
    """Both files, each replaced in one step. Raises UserError when the disk refuses."""
    for name, text in (("results.tsv", results_table(view)), ("search_journal.md", journal(view))):
        write_whole(directory / name, text.encode("utf-8", "replace"), durable=False)


def results_table(view: SearchView) -> str:
    """Write the experiments as a tab-separated table.

    Columns: experiment, val, status, description, parent, seconds of the evaluation, val of each
    fold, and in a relay the agent. A failure has no number. With validation early stopping the name
    of the second column says so.
    """
    val = view.v_name.replace("V", "val", 1)
    rows = [
        f"experiment\t{val}\tstatus\tdescription\tparent\tseconds\tfolds"
        + ("\tagent" if view.leg else "")
    ]
    for e in view.finished:
        assert e.result is not None
        cells = (
            str(e.number),
            f"{e.score.value:.6f}" if e.score else "",
            e.result.status,
            table_cell(_description(e)),
            "" if e.proposed.parent is None else str(e.proposed.parent),
            f"{e.result.seconds:.1f}",
            " ".join(f"{fold.value:.6f}" for fold in e.score.folds) if e.score else "",
        )
        agent = (table_cell(e.proposed.agent),) if view.leg else ()
        rows.append("\t".join((*cells, *agent)))
    return "\n".join(rows) + "\n"


def _description(e: Experiment) -> str:
    """The title; the whole hypothesis where the title is only its beginning; the mean of V over
    seeds where there is one."""
    title, hypothesis = e.proposed.title, e.proposed.hypothesis
    text = hypothesis if hypothesis.startswith(title.removesuffix("…")) else title
    return f"{text} ({mean})" if (mean := seed_mean_words(e)) else text


def journal(view: SearchView) -> str:
    """Write the journal of a search: hypothesis, reason and result of each experiment."""
    start = view.started
    parts = [
        f"# Search journal: {markdown_line(start.run)}\n\n"
        f"Problem {markdown_line(start.problem)}, agent {markdown_line(start.agent)}, "
        f"seed {start.seed}, isolation {start.isolation_words}.\n"
        f"{_references(view)}{_setting(view)}"
    ]
    finished = view.finished
    for e, later in zip_longest(finished, finished[1:]):
        parts += [_hand_over(event) for event in view.handed_over if event.after == e.number - 1]
        parts.append(_entry(view, e, later))
    return "\n".join(parts)


def _references(view: SearchView) -> str:
    if not view.rungs:
        return ""
    values = [
        f"{reference.name} {error_value(reference.outcome.value)}"
        for reference in view.rungs
        if isinstance(reference.outcome, Score)
    ]
    return f"\nReference models, {view.v_name}: {', '.join(values)}.\n"


def _setting(view: SearchView) -> str:
    return _validation_setting(view) + _residuals_setting(view)


def _residuals_setting(view: SearchView) -> str:
    if view.started.residuals == "train":
        return ""
    return (
        "\nHeld-out residuals are shown: the agent sees the errors on the held-out samples. V is "
        "only comparable with V of the same setting.\n"
    )


def _validation_setting(view: SearchView) -> str:
    if view.started.early_stopping == "inner":
        return ""
    return (
        "\nValidation early stopping: candidates received their score on the held-out parts, "
        f"{view.validation_scores} times so far. V is not leak-free and only comparable with V "
        "of the same setting.\n"
    )


def _hand_over(event: HandedOver) -> str:
    return f"## Hand-over\n\n{markdown_line(hand_over_text(event))}.\n"


def _entry(view: SearchView, e: Experiment, later: Experiment | None) -> str:
    p, r = e.proposed, e.result
    assert r is not None
    origin = f" (from experiment {p.parent})" if p.parent else ""
    by = f", by {markdown_line(p.agent)}" if p.agent else ""
    following = markdown_line(later.proposed.title) if later else "none yet"
    remark = f"- **Remark:** {markdown_line(p.remark)}\n" if p.remark else ""
    return (
        f"## Experiment {e.number}: {markdown_line(p.title)}\n\n"
        f"- **Changed:** {markdown_line(p.family)}, {phase_text(p.phase)}{origin}{by}\n"
        f"- **Hypothesis:** {markdown_line(p.hypothesis)}\n"
        f"- **Expected:** {markdown_line(p.expected)}\n"
        f"- **Result:** {markdown_line(describe_result(e, view))}\n"
        f"- **Decision:** {r.status}\n"
        f"- **Next:** {following}\n{remark}"
    )
