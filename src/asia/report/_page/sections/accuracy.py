"""The winner on the data that it was not fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from asia.data import Array
from asia.ledger import Experiment
from asia.protocol import Fold, find_metric
from asia.report._artifacts import fold_outputs
from asia.report._page.html import Html, join, said, table, tag
from asia.report._page.overlay import MOST_PANELS, Overlay, draw_overlays
from asia.report._page.section import Section
from asia.report._page.subject import Subject, result_of
from asia.report._pictures.simulation import lowest, worst_fits
from asia.report._pictures.windows import telling


def _write(subject: Subject) -> Html | None:
    best = subject.view.best
    if best is None:
        return None
    text = (
        "Each fold of the cross-validation held out a part of the training records. Its model "
        "simulated that part from its start, without seeing a measured output on the way."
    )
    return join((tag("p", text), _table(subject, best), _pictures(subject, best)))


def _table(subject: Subject, best: Experiment) -> Html:
    result, score, metric = result_of(best), best.score, find_metric(subject.run.metric)
    assert score is not None
    outputs = subject.view.started.outputs
    wide = len(outputs) > 4
    head: list[str] = [
        "fold",
        "V",
        *([] if wide else [join((said(metric.label), " ", said(name))) for name in outputs]),
    ]
    head += ["lowest fit index", "error on its training data", "seconds of the fit"]
    field = metric.name if metric.name in ("rmse", "mae") else "other"
    rows: list[list[str | None]] = []
    for k, fold in enumerate(score.folds):
        at = f"outcome.folds.{k}"
        fits = [
            (result, f"{at}.fit_index.{c}") for c, f in enumerate(fold.fit_index) if f is not None
        ]
        errors = [subject.number(result, f"{at}.{field}.{c}", "sig4") for c in range(len(outputs))]
        rows.append(
            [
                _fold_name(subject, k),
                subject.number(result, f"{at}.value", "error"),
                *([] if wide else errors),
                subject.made("least", "percent", *fits) if fits else "none",
                subject.number(result, f"folds.{k}.diagnostics.train_error", "error"),
                subject.number(result, f"folds.{k}.fit_seconds", "sig3"),
            ]
        )
    return table(head, rows, "The winner on each fold")


def _fold_name(subject: Subject, fold: int) -> Html:
    names = subject.view.started.folds
    number = tag("span", f"{fold + 1}", class_="fixed")
    return join((number, ": ", said(names[fold]))) if fold < len(names) else number


def _pictures(subject: Subject, best: Experiment) -> Html | None:
    problem, parts = subject.problem, held_out_overlays(subject, best)
    return draw_overlays(problem, parts) if problem is not None and parts else None


def held_out_overlays(subject: Subject, experiment: Experiment) -> list[Overlay]:
    """Return the simulations of an experiment's fold models on their held-out data, lowest fit
    first; none without a score or the data.
    """
    problem, score = subject.problem, experiment.score
    if problem is None or score is None:
        return []
    folds = subject.folds
    channels = lowest(worst_fits(score), max(1, MOST_PANELS // len(folds)))
    outputs = fold_outputs(subject.run.store, experiment, folds)
    windows = problem.protocol.kind == "windows"
    return [
        part
        for channel in channels
        for fold, y_hat in zip(folds, outputs, strict=True)
        for part in _parts(subject, fold, y_hat, channel, windows=windows)
    ]


def _parts(
    subject: Subject, fold: Fold, y_hat: Sequence[Array], channel: int, *, windows: bool
) -> Iterator[Overlay]:
    """The first block of a fold, or its best and its worst window."""
    chosen = [("held-out part", 0)]
    if windows:
        found = telling([block.y for block in fold.validation], y_hat, fold.scale)
        chosen = [(f"{word} window", index) for word, index in found if word != "median"]
    for what, index in chosen:
        block = fold.validation[index]
        yield Overlay(
            title=join((f"{what} of fold ", _fold_name(subject, fold.index))),
            alt=f"{what} of fold {fold.index + 1}",
            channel=channel,
            first=block.start,
            measured=block.y,
            simulated=y_hat[index],
        )


SECTION = Section("accuracy", "Accuracy", _write)
