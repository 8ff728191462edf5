"""results.tsv and search_journal.md, generated from the view."""

from itertools import zip_longest
from pathlib import Path

from asia._text import markdown_line, table_cell
from asia.judge.scoring.outcome import Score
from asia.ledger.chain import write_whole
from asia.ledger.view import SearchView
from asia.presentation.experiments import describe_result, phase_text, seed_mean_words
from asia.presentation.table import error_value


def write_exports(directory: Path, view: SearchView) -> None:
    """Both files, each replaced in one step. Raises UserError when the disk refuses."""
    for name, text in (("results.tsv", results_table(view)), ("search_journal.md", journal(view))):
        write_whole(directory / name, text.encode("utf-8", "replace"), durable=False)


def results_table(view: SearchView) -> str:
    """Write the experiments as a tab-separated table.

    Columns: experiment, val, status, description, parent, seconds of the evaluation, val of each
    fold. A failure has no number. With validation early stopping the name of the second column says
    so.
    """
    val = view.v_name.replace("V", "val", 1)
    rows = [f"experiment\t{val}\tstatus\tdescription\tparent\tseconds\tfolds"]
    for e in view.finished:
        assert e.result is not None
        mean = seed_mean_words(e)
        cells = [
            str(e.number),
            f"{e.score.value:.6f}" if e.score else "",
            e.result.status,
            table_cell(f"{e.description} ({mean})" if mean else e.description),
            "" if e.proposed.parent is None else str(e.proposed.parent),
            f"{e.result.seconds:.1f}",
            " ".join(f"{fold.value:.6f}" for fold in e.score.folds) if e.score else "",
        ]
        rows.append("\t".join(cells))
    return "\n".join(rows) + "\n"


def journal(view: SearchView) -> str:
    """Write the journal of a search: hypothesis, reason and result of each experiment."""
    start = view.started
    head = (
        f"# Search journal: {markdown_line(start.run)}\n\n"
        f"Problem {markdown_line(start.problem)}, agent {markdown_line(start.agent)}, "
        f"seed {start.seed}, isolation {start.isolation_words}.\n"
    )
    if view.references:
        values = [
            f"{reference.name} {error_value(reference.outcome.value)}"
            for reference in view.references
            if isinstance(reference.outcome, Score)
        ]
        head += f"\nReference models, {view.v_name}: {', '.join(values)}.\n"
    if start.early_stopping != "inner":
        head += (
            "\nValidation early stopping: candidates received their score on the held-out parts, "
            f"{view.validation_scores} times so far. V is not leak-free and only comparable with V "
            "of the same setting.\n"
        )
    if start.residuals != "train":
        head += (
            "\nHeld-out residuals are shown: the agent sees the errors on the held-out samples. V "
            "is only comparable with V of the same setting.\n"
        )
    parts = [head]
    finished = view.finished
    for e, later in zip_longest(finished, finished[1:]):
        p, r = e.proposed, e.result
        assert r is not None
        origin = f" (from experiment {p.parent})" if p.parent else ""
        following = markdown_line(later.proposed.title) if later else "none yet"
        remark = f"- **Remark:** {markdown_line(p.remark)}\n" if p.remark else ""
        parts.append(
            f"## Experiment {e.number}: {markdown_line(p.title)}\n\n"
            f"- **Changed:** {markdown_line(p.family)}, {phase_text(p.phase)}{origin}\n"
            f"- **Hypothesis:** {markdown_line(p.hypothesis)}\n"
            f"- **Expected:** {markdown_line(p.expected)}\n"
            f"- **Result:** {markdown_line(describe_result(e, view))}\n"
            f"- **Decision:** {r.status}\n"
            f"- **Next:** {following}\n{remark}"
        )
    return "\n".join(parts)
