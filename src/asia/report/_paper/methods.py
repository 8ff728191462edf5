"""The paragraph on methods that a paper needs, from the ledger alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from asia._text import one_line
from asia.ledger import (
    Run,
    SearchView,
    TestedModel,
    error_value,
    metric_of,
    model_to_use,
    open_run,
    tested_model,
)
from asia.protocol import find_metric, metric_label
from asia.scoring import Score

_MODELS = {
    "ensemble": "the mean of the models of all folds",
    "refit": "the winner fitted to all training records",
    "stack": "a weighted mean of several candidates",
}


def methods_paragraph(directory: Path) -> str:
    """See `asia.report.methods_paragraph`."""
    run = open_run(directory)
    return " ".join(_sentences(run, metric_of(directory)))


def _sentences(run: Run, metric: str) -> Iterator[str]:
    view = run.view
    start = view.started
    version = start.environment.get("asia-sysid", "of an unknown version")
    yield (
        f"The model of {_words(start.problem)} was searched for with ASIA {version}, agent "
        f"{_words(start.agent)}, seed {start.seed}."
    )
    yield from _judged(view, metric)
    yield from _kept_apart(view)
    yield from _found(view)
    yield from _tested(view)
    yield (
        f"The ledger of the search holds {len(run.lines)} events, each with the hash of the one "
        f"before; the problem, as it was, has the SHA-256 {start.lock_digest[:16]}."
    )


def _judged(view: SearchView, metric: str) -> Iterator[str]:
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
    references = [
        f"{_words(r.name)} {error_value(r.outcome.value)}"
        for r in view.rungs
        if isinstance(r.outcome, Score)
    ]
    if references:
        yield f"Trivial references have V: {', '.join(references)}."


def _kept_apart(view: SearchView) -> Iterator[str]:
    start = view.started
    layers = f" ({', '.join(start.layers)})" if start.layers else ""
    yield (
        f"Candidates ran in processes of their own at isolation level {start.isolation_words}"
        f"{layers}; errors were computed outside, from outputs that candidates never received."
    )
    if start.early_stopping == "validation":
        yield (
            f"During training they received {view.validation_scores} scores on held-out "
            "parts, so V is not leak-free."
        )
    if start.residuals == "held_out":
        yield "The agent saw the residuals on the held-out parts."
    if view.usage is not None:
        cost = "" if view.usage.cost is None else f" for {view.usage.cost:.2f} USD"
        tokens = f"{view.usage.tokens} tokens{cost}"
        yield f"The language model was asked {view.usage.turns} times, {tokens}."
    if view.notes:
        yield f"The user gave the agent {len(view.notes)} notes."


def _found(view: SearchView) -> Iterator[str]:
    best, named = view.best, model_to_use(view)
    if best is None or best.score is None or named is None:
        yield "No candidate has a score."
        return
    folds = ", ".join(error_value(f.value) for f in best.score.folds)
    yield (
        f"The best candidate, number {best.number} ({_words(best.proposed.title)}), has "
        f"{view.v_name} = {error_value(best.score.value)} (folds {folds})."
    )
    yield from _confirmed(view)
    if view.refitted is not None:
        yield f"The model handed over is {_MODELS[named.model]}, chosen without test data."


def _confirmed(view: SearchView) -> Iterator[str]:
    found = view.confirmed
    if found is None or found.expected is None:
        return
    ends = f"{error_value(found.expected.low)} to {error_value(found.expected.high)}"
    yield (
        f"After the search the {len(found.candidates)} candidates with the lowest V were fitted "
        f"again, from {found.seeds} seeds; on a new record of the same kind a fold model of the "
        f"best of the {found.tried} tried is expected to have {error_value(found.expected.value)} "
        f"({100 * found.expected_level:g} % interval {ends})."
    )


def _tested(view: SearchView) -> Iterator[str]:
    opened, named = view.unsealed, model_to_use(view)
    if view.started.test_digest is None:
        yield "There was no sealed test."
        return
    seal = f"SHA-256 {view.started.test_digest[:16]}, recorded before the first experiment"
    if opened is None or named is None:
        yield f"The test records ({seal}) have not been opened."
        return
    yield f"The test records ({seal}) were opened once, after the search had ended."
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
        held = ", ".join(f"{100 * share:.1f} % of {_words(name)}" for name, share in names)
        yield f"Output bands of {100 * opened.bands.level:g} % held {held}."


def _words(text: str) -> str:
    return one_line(text, 120)
