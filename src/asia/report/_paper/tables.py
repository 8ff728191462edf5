"""LaTeX tables of a run, for `\\input`; they need booktabs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from asia._text import one_line
from asia.ledger import (
    Experiment,
    IdentifiedModel,
    SearchView,
    TestedModel,
    Unsealed,
    error_value,
    identified,
    metric_of,
    model_to_use,
    open_run,
    write_whole,
)
from asia.protocol import find_metric, metric_label
from asia.scoring import Score

_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "%": r"\%", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
}  # fmt: skip
_MARKED = re.compile("[" + re.escape("".join(_SPECIAL)) + "]")
_MODELS = (
    ("ensemble", "ensemble of the fold models"),
    ("refit", "refit on all training records"),
    ("stack", "stack of several experiments"),
)


def write_tables(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """See `asia.report.write_tables`."""
    run = open_run(run_directory)
    view = run.view
    tables = {"experiments": _experiments(view), "winner": _winner(view, metric_of(run_directory))}
    found = identified(run)
    if found is not None and found.parameters:
        tables["parameters"] = _parameters(view, found)
    if view.unsealed is not None:
        tables["test"] = _test(view, view.unsealed)
    directory.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for name, text in tables.items():
        path = directory / f"{name}.tex"
        write_whole(path, text.encode("utf-8", "replace"), durable=False)
        paths.append(path)
    return tuple(paths)


def latex(text: str) -> str:
    """Words from elsewhere on one line, as LaTeX prints them."""
    return _MARKED.sub(lambda found: _SPECIAL[found[0]], one_line(text))


def _table(columns: str, head: Sequence[str], rows: Iterable[Sequence[str]], note: str) -> str:
    lines = [f"% {note}", rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    lines += [" & ".join(head) + r" \\", r"\midrule"]
    lines += [" & ".join(row) + r" \\" for row in rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _note(view: SearchView, what: str) -> str:
    return one_line(f"{what}, run {view.started.run}; needs booktabs")


def _experiments(view: SearchView) -> str:
    head = ["No.", "Candidate", latex(view.v_name).replace("V", "$V$", 1), "Change", "Decision"]
    rows = [_experiment(view, e) for e in view.finished]
    return _table("rlrrl", head, rows, _note(view, "Every experiment; change to the best before"))


def _experiment(view: SearchView, e: Experiment) -> list[str]:
    before = [o.score.value for o in view.bests if o.number < e.number and o.score]
    value, change = "--", "--"
    if e.score is not None:
        value = error_value(e.score.value)
        if before and before[-1]:
            change = rf"{100 * (e.score.value - before[-1]) / before[-1]:+.1f}\,\%"
            change = f"${change}$"
    status = e.result.status if e.result else ""
    return [str(e.number), latex(e.proposed.title), value, change, status]


def _winner(view: SearchView, metric: str) -> str:
    """Write V of the winner on each fold, with the reference models."""
    best = view.best
    scores = [(r.name, r.outcome) for r in view.rungs if isinstance(r.outcome, Score)]
    if best is not None and best.score is not None:
        scores.append((best.proposed.title, best.score))
    folds = max((len(score.folds) for _, score in scores), default=0)
    head = ["Model", "$V$", *(f"fold {k + 1}" for k in range(folds))]
    rows = [
        [latex(name), error_value(score.value), *(error_value(f.value) for f in score.folds)]
        for name, score in scores
    ]
    what = (
        f"The winner and the reference models, {metric_label(metric)} over the standard deviation "
        "of the output"
    )
    return _table("l" + "r" * (folds + 1), head, rows, _note(view, what))


def _parameters(view: SearchView, found: IdentifiedModel) -> str:
    """Write the parameters of the refit with their uncertainty."""
    rows: list[list[str]] = []
    for row in found.parameters:
        one, ends = row.fitted, row.interval
        interval = "--" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}"
        source = "--" if ends is None else row.decided_by
        spread = "--" if row.fold_error is None else f"{row.fold_error:.2g}"
        error = "--" if one.standard_error is None else f"{one.standard_error:.2g}"
        remark = "" if one.identifiable else "not identifiable"
        rows.append([latex(one.name), f"{one.value:.5g}", latex(one.unit), error, spread, interval,
                     source, remark])  # fmt: skip
    head = ["Parameter", "Value", "Unit", "Standard error", "by folds", r"95\,\% interval",
            "decided by", ""]  # fmt: skip
    what = "Parameters of the winner, fitted to all training records"
    return _table("lrlrrrll", head, rows, _note(view, what))


def _test(view: SearchView, opened: Unsealed) -> str:
    """A row for each metric and output, a column for each model."""
    named = model_to_use(view)
    found = [(key, text, getattr(opened, key)) for key, text in _MODELS]
    models = [(key, text, m) for key, text, m in found if isinstance(m, TestedModel)]
    rows: list[list[str]] = []
    for k, score in enumerate(models[0][2].scores if models else ()):
        label = latex(find_metric(score.metric).label)
        scores = [model.scores[k] for _, _, model in models]
        if len(opened.channels) > 1:
            values = (f"{s.value:.4g}" for s in scores)
            rows.append([f"{label}, mean over the outputs", *values])
        for c, name in enumerate(opened.channels):
            values = (f"{s.per_channel[c]:.4g}" for s in scores)
            rows.append([f"{label} {latex(name)}", *values])
    use = named.model if named is not None else ""
    head = ["Error", *(f"{text} (to use)" if key == use else text for key, text, _ in models)]
    what = "The sealed test, in the units of the outputs"
    return _table("l" + "r" * len(models), head, rows, _note(view, what))
