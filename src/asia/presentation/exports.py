"""results.tsv and search_journal.md, generated from the view."""

from itertools import zip_longest
from pathlib import Path

from asia._text import markdown_line, table_cell
from asia.ledger.chain import write_whole
from asia.ledger.view import SearchView
from asia.presentation.experiments import experiment_facts, references_text, seed_mean_words
from asia.presentation.integrity import v_notes


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
        head += f"\nReference models, {view.v_name}: {markdown_line(references_text(view))}.\n"
    head += "".join(f"\nV is {words}.\n" for words in v_notes(view))
    parts = [head]
    finished = view.finished
    for e, later in zip_longest(finished, finished[1:]):
        following = later.proposed.title if later else "none yet"
        facts = [*experiment_facts(e, view), ("next", following)]
        lines = (f"- **{label.capitalize()}:** {markdown_line(text)}" for label, text in facts)
        title = f"## Experiment {e.number}: {markdown_line(e.proposed.title)}"
        parts.append("\n".join((title, "", *lines, "")))
    return "\n".join(parts)
