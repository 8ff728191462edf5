"""LaTeX tables and the methods paragraph of a paper."""

import re
from collections.abc import Iterator
from pathlib import Path

from asia._text import one_line
from asia.judge.scoring.outcome import Score
from asia.ledger.chain import write_whole
from asia.ledger.events import TestedModel
from asia.ledger.evidence import IdentifiedModel, identified
from asia.ledger.run import metric_of, model_to_use, open_run, tested_model
from asia.ledger.view import SearchView
from asia.presentation.experiments import experiments_table, references_text
from asia.presentation.integrity import isolation_text, sealed_test_text, usage_text, v_notes
from asia.presentation.parameters import parameter_remarks, parameter_table
from asia.presentation.results import sealed_test_blocks, use_text
from asia.presentation.table import Block, Table, error_value
from asia.problem.metrics import find_metric, metric_label


def methods_paragraph(directory: Path) -> str:
    """Write the methods paragraph of a paper from the ledger of a run.

    Args:
        directory: run directory.

    Raises:
        UserError: the directory is not a run.
    """
    run = open_run(directory)
    view, start = run.view, run.view.started
    version = start.environment.get("asia-sysid", "of an unknown version")
    sentences = [
        f"The model of {_quoted(start.problem)} was searched for with ASIA {version}, agent "
        f"{_quoted(start.agent)}, seed {start.seed}.",
        *_search(view, metric_of(directory)),
        *_isolation(view),
        *_best(view),
        *_sealed_test(directory, view),
        f"The ledger of the search holds {len(run.lines)} events, each with the hash of the one "
        f"before; the problem, as it was, has the SHA-256 {start.lock_digest[:16]}.",
    ]
    return " ".join(sentences)


def _search(view: SearchView, metric: str) -> Iterator[str]:
    best = view.best
    folds = len(best.score.folds) if best is not None and best.score is not None else 0
    failed = sum(e.score is None for e in view.finished)
    without = f", of which {failed} gave no score" if failed else ""
    yield (
        f"It evaluated {len(view.finished)} candidates{without}, each by cross-validation"
        + (f" over {folds} folds" if folds else "")
        + f" of open-loop simulation: V is the {metric_label(metric)} on the held-out part over "
        "the standard deviation of the output in the training part, mean over outputs and folds."
    )
    if view.references:
        yield f"Reference models have {view.v_name}: {references_text(view)}."


def _isolation(view: SearchView) -> Iterator[str]:
    yield (
        "Candidates ran in processes of their own at isolation level "
        f"{isolation_text(view.started)}; errors were computed outside, from outputs that "
        "candidates never received."
    )
    yield from (f"V is {words}." for words in v_notes(view))
    if view.usage is not None:
        yield f"The language model gave {usage_text(view.usage)}."
    if view.notes:
        yield f"The user gave the agent {len(view.notes)} notes."


def _best(view: SearchView) -> Iterator[str]:
    best, named, confirmed = view.best, model_to_use(view), view.confirmed
    if best is None or best.score is None or named is None:
        yield "No candidate has a score."
        return
    folds = ", ".join(error_value(f.value) for f in best.score.folds)
    yield (
        f"The best candidate, number {best.number} ({_quoted(best.proposed.title)}), has "
        f"{view.v_name} = {error_value(best.score.value)} (folds {folds})."
    )
    if confirmed is not None and confirmed.expected is not None:
        expected = confirmed.expected
        ends = f"{error_value(expected.low)} to {error_value(expected.high)}"
        yield (
            f"After the search the {len(confirmed.candidates)} candidates with the lowest V were "
            f"fitted again, from {confirmed.seeds} seeds; on a new record of the same kind a fold "
            f"model of the best of the {confirmed.tried} tried is expected to have "
            f"{error_value(expected.value)} ({100 * confirmed.expected_level:g} % interval {ends})."
        )
    if view.refitted is not None:
        use = use_text(named.model, view.refitted)
        yield f"The model handed over is {use}, chosen without test data."


def _sealed_test(directory: Path, view: SearchView) -> Iterator[str]:
    opened, named = view.unsealed, model_to_use(view)
    yield f"Sealed test: {sealed_test_text(directory, view)}."
    if opened is None or named is None:
        return
    model = tested_model(opened, named.model)
    if not isinstance(model, TestedModel):
        yield "The model fails on them."
        return
    errors = ", ".join(f"{find_metric(s.metric).label} {s.value:.4g}" for s in model.scores)
    how = f"windows of {opened.horizon} samples"
    if opened.horizon is None:
        how = f"the first {opened.skip} samples of each left out"
    yield f"On them its error is {errors} ({how})."
    if opened.bands is not None and opened.bands.model == named.model:
        names = zip(opened.channels, opened.bands.covered, strict=True)
        held = ", ".join(f"{100 * share:.1f} % of {_quoted(name)}" for name, share in names)
        yield f"Output bands of {100 * opened.bands.level:g} % held {held}."


def _quoted(text: str) -> str:
    return one_line(text, 120)


# LaTeX tables of a run, for `\input`; they need booktabs.


_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "%": r"\%", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
}  # fmt: skip


def write_tables(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """LaTeX tables of a run into `directory`: `experiments.tex`, `best.tex`, and
    `test.tex` once the test was opened. Returns the paths written. Raises UserError when
    `run_directory` is not a run."""
    run = open_run(run_directory)
    view, model = run.view, identified(run)
    tables: dict[str, list[Block]] = {
        "experiments": [experiments_table(view.finished, view)],
        "best": [_best_table(view, metric_of(run_directory))],
    }
    if model is not None and model.parameters:
        tables["parameters"] = [_parameters_table(model)]
    if view.unsealed is not None and (named := model_to_use(view)) is not None:
        tables["test"] = [*sealed_test_blocks(view.unsealed, named.model)]
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{name}.tex" for name in tables]
    for path, blocks in zip(paths, tables.values(), strict=True):
        text = "\n".join(_table(view, one) for one in blocks if isinstance(one, Table))
        write_whole(path, text.encode("utf-8", "replace"), durable=False)
    return tuple(paths)


def latex(text: str) -> str:
    """Text from elsewhere on one line, as LaTeX prints it."""
    special = "[" + re.escape("".join(_SPECIAL)) + "]"
    return re.sub(special, lambda found: _SPECIAL[found[0]], one_line(text))


def _table(view: SearchView, table: Table) -> str:
    note = one_line(f"{table.caption}, run {view.started.run}; needs booktabs")
    columns = "".join("l" if text else "r" for text in table.is_text)
    lines = [f"% {note}", rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    head = (re.sub(r"^V\b", "$V$", latex(title)) for title in table.head)
    lines += [" & ".join(head) + r" \\", r"\midrule"]
    lines += [" & ".join(map(_latex_cell, row, table.is_text)) + r" \\" for row in table.cells]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _latex_cell(cell: str, text: bool) -> str:
    if text:
        return latex(cell)
    return re.sub(r"[+-](?=\d)[\d.]+", r"$\g<0>$", latex(cell)) or "--"


def _best_table(view: SearchView, metric: str) -> Table:
    """V of the best candidate on each fold, with the reference models."""
    best = view.best
    scores = [(r.name, r.outcome) for r in view.references if isinstance(r.outcome, Score)]
    if best is not None and best.score is not None:
        scores.append((best.proposed.title, best.score))
    folds = max((len(score.folds) for _, score in scores), default=0)
    each = dict.fromkeys([f"fold {k + 1}" for k in range(folds)], "error")
    return Table(
        f"the best candidate and the reference models, {metric_label(metric)} over the standard "
        "deviation of the output",
        {"model": "", "V": "error", **each},
        [(name, score.value, *(f.value for f in score.folds)) for name, score in scores],
    )


def _parameters_table(found: IdentifiedModel) -> Table:
    table = parameter_table(found)
    remarks = ("; ".join(parameter_remarks(found, one)) for one in found.parameters)
    rows = [(*row, remark) for row, remark in zip(table.rows, remarks, strict=True)]
    return Table(table.caption, {**table.columns, "remark": ""}, rows)
