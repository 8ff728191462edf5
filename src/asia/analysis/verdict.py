"""Verdict on the model that a search hands over, from the facts of its ledger alone. Every
interface prints this one object."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from asia.data.trajectory import Array
from asia.judge.scoring.bands import KNOWN_WITHIN
from asia.judge.scoring.checks.check import ALARM_RATE, Verdict
from asia.judge.scoring.confirmation import FAR_ABOVE_V
from asia.judge.scoring.outcome import (
    SUSPICIOUS_RATIO,
    USABLE_SHARE,
    Score,
    consistency,
    explained_variance,
    folds_below,
)
from asia.ledger.events import BOUNDED_REACH, TestedModel
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.view import BELOW_TRUTH, SearchView
from asia.presentation.experiments import stress_text


class Level(NamedTuple):
    """One requirement on a model that is called usable."""

    statistic: str
    level: float
    source: str


EXPLAINED = Level(
    "least share of the variance of an output, about its own mean in the fold, that the model "
    "explains; 0 or less of a fold: not usable",
    USABLE_SHARE,
    "R2 (Ljung, System Identification, 16.4); half of the variance is the definition of usable",
)
AGREEMENT = Level(
    "the same share for every other seed of the fit, and for each fold model as a model of the "
    "others' simulations",
    EXPLAINED.level,
    "as above",
)
COVERAGE = Level(
    "largest standard error of the share that 90 % bands hold of folds that did not make them; "
    "otherwise the bands are withdrawn",
    KNOWN_WITHIN,
    "jackknife over folds after widening (CV+, Barber and others, Annals of Statistics 49, 2021)",
)
BOUNDED = Level(
    "largest distance of a stress simulation from the middle of the training range, in half ranges",
    BOUNDED_REACH,
    "five times the range of the records is another operating region; a linear model or an "
    "integrator may go further (stress simulation)",
)
ALARMS = Level(
    "probability of chance below which a check of the validation fails",
    ALARM_RATE,
    "null distribution of each check; of a family of tests by Holm's method",
)
REPEATED = Level(
    "relative difference of the error of a second fit", 0.01, "a fit with fixed seeds is repeatable"
)
HONEST = Level(
    "least V over the error on the training records",
    SUSPICIOUS_RATIO,
    "honest candidates lie above 0.9",
)
TRUE = Level(
    "least V over that of the simulated truth",
    BELOW_TRUTH,
    "three standard deviations of chance with 225 samples",
)
TESTED = Level("largest test error over V", FAR_ABOVE_V, "0.83 to 2.3 in 12 honest searches")
LEVELS = (EXPLAINED, AGREEMENT, COVERAGE, BOUNDED, ALARMS, REPEATED, HONEST, TRUE, TESTED)
"""All levels of the verdict; `docs/design/model-to-use.md` has the same table."""


@dataclass(frozen=True)
class Usability:
    """Verdict on the model to use."""

    kind: Literal["usable", "not validated", "doubtful", "not usable"]
    """not validated: nothing speaks against the model, but its validation is not done."""
    reasons: tuple[str, ...]
    """Sentences, the most important first; empty for a usable model."""


def usability(view: SearchView) -> Usability | None:
    """Judge the model to use by the levels of the table; None while there is no model."""
    best = view.best
    if best is None or best.score is None:
        return None
    findings = [_Finding(f"{text[:1].upper()}{text[1:]}.", grave=True) for text in alarms(view)]
    for find in (_explained, _feedback, _stress, _checks, _agreement, _honesty):
        findings += find(view)
    if findings:
        findings.sort(key=lambda one: not one.grave)
        kind = "not usable" if findings[0].grave else "doubtful"
        return Usability(kind, tuple(one.sentence for one in findings))
    if view.validated or _controls(view):
        return Usability("usable", ())
    if view.refitted is None:
        return Usability("not validated", ("The search is not finished.",))
    command = f"asia validate {view.started.run}"
    return Usability("not validated", (f"Nothing speaks against it so far: run {command}.",))


@dataclass(frozen=True)
class _Finding:
    """Something that speaks against a model."""

    sentence: str
    grave: bool = False
    """Whether the model is not usable for this reason; otherwise it is doubtful."""


_Findings = Iterator[_Finding]


def _controls(view: SearchView) -> bool:
    """Return whether a controller is searched for, whose errors are in tolerances."""
    from asia.judge.evaluation.references import CONTROLLERS  # brings the sandbox

    return any(reference.name in CONTROLLERS for reference in view.references)


def _explained_variance(view: SearchView) -> Array | None:
    """Share (K, ny) of the variance that the model to use explains, see `explained_variance`. None
    for controllers, and without a score."""
    best, refitted = view.best, view.refitted
    if best is None or best.score is None or _controls(view):
        return None
    stack = refitted.stack if refitted is not None and refitted.use == "stack" else None
    return explained_variance(best.score, () if stack is None else stack.folds)


def _explained(view: SearchView) -> _Findings:
    share, refitted, best = _explained_variance(view), view.refitted, view.best
    if share is None or best is None or best.score is None:
        return
    worse, outputs = folds_below(share, 0.0), view.started.outputs
    if worse:
        cause = refitted.cause if refitted is not None else ""
        least = min(float(np.nanmean(share[fold - 1])) for fold in worse)
        yield _Finding(
            f"It is worse than the mean of the output in fold {', '.join(map(str, worse))} "
            f"(explained variance {least:.2g}).",
            grave=True,
        )
        yield _Finding(
            cause
            or view.experiments[-1].proposed.remark
            or "Do the inputs act on the outputs? Was the plant in closed loop? Is it unstable? "
            "Read the output of asia check. For an unstable plant use short windows: "
            'kind = "windows" in [protocol].',
            grave=True,
        )
        return
    low = [tuple(place) for place in np.argwhere(share < EXPLAINED.level).tolist()]
    if low:
        fold, output = min(low, key=lambda place: share[place])
        more = f"; it explains less than half in {len(low)} of {share.size} cases"
        yield _Finding(
            f"It explains {share[fold, output]:.0%} of the variance of {outputs[output]} in fold "
            f"{fold + 1}{more if len(low) > 1 else ''}. A usable model explains at least half."
        )
    for fold, output in np.argwhere(np.isnan(share)).tolist()[:1]:
        yield _Finding(
            f"Fold {fold + 1} does not test the model, because {outputs[output]} hardly moves "
            "there: use fewer folds, or record more."
        )
    linear = next((r.outcome for r in view.references if r.name == "linear model"), None)
    if isinstance(linear, Score):
        pairs = zip(best.score.folds, linear.folds, strict=True)
        if all(own.value > other.value for own, other in pairs):
            yield _Finding(
                f"A linear model is better in every fold (V {linear.value:.3g}, this one "
                f"{best.score.value:.3g})."
            )


def _feedback(view: SearchView) -> _Findings:
    loop = None if view.refitted is None else view.refitted.feedback
    if loop is None:
        return
    if loop.declared:
        other = f"#{loop.sound:02d}, " if loop.sound is not None else ""
        yield _Finding(
            "The records come from a closed loop, and this model was fitted as if they did "
            "not: its gains may be biased, which V on such records does not show. Compare "
            f'{other}linear with loop = "direct", or set inputs = "explained" in [loop].'
        )
        return
    many = len(loop.inputs) > 1
    who = f"Input{'s' * many} {', '.join(loop.inputs)} follow{'s' * (not many)} earlier outputs"
    advice = "Name the measured reference in [loop]."
    if loop.pole is None:
        yield _Finding(f"{who}: in closed loop the model may describe the controller. {advice}")
        return
    yield _Finding(
        f"{who}, and the plant between them is unstable (largest pole {loop.pole:.3g}): a "
        f"controller holds it, and this model describes both. {advice}",
        grave=True,
    )


def _stress(view: SearchView) -> _Findings:
    refitted = view.refitted
    if refitted is None:
        return
    if any("stress simulation" in line for line in refitted.failed_checks):
        yield _Finding("The stress simulation failed, so nothing is known of other inputs.")
    test = refitted.stress[-1] if refitted.stress else None
    if test is not None and test.outcome != "bounded":
        advice = "Record more levels, each input with steps of its own."
        if test.outcome != "diverges":
            advice = f"Is the plant an integrator? If not: {advice[:1].lower()}{advice[1:]}"
        yield _Finding(f"{stress_text(test)} {advice}", grave=test.outcome == "diverges")


def _checks(view: SearchView) -> _Findings:
    for validation in view.validated:
        where = f" on the record {validation.record}" if validation.record else ""
        for check in validation.checks:
            if check.verdict is Verdict.FAIL:
                cause = f" ({check.cause})" if check.cause else ""
                sentence = f"The check '{check.name}' fails{where}{cause}."
                yield _Finding(sentence, grave=check.weight > 1.0)


def _agreement(view: SearchView) -> _Findings:
    best, refitted, share = view.best, view.refitted, _explained_variance(view)
    if best is None or best.score is None or share is None or np.isnan(share).all():
        return
    if refitted is not None and refitted.use == "stack":
        return  # A mean of candidates: their folds are judged together.
    seeds, value = best.seed_values, best.score.value
    if len(seeds) > 1 and value > 0.0:
        least = 1.0 - (1.0 - float(np.nanmean(share))) * (max(seeds) / value) ** 2
        if least < AGREEMENT.level:
            yield _Finding(
                f"Other seeds give V from {min(seeds):.3g} to {max(seeds):.3g}: the worst one "
                f"explains {least:.0%} of the variance."
            )
    check = None if refitted is None else refitted.check
    apart = check.fold_disagreement if check is not None else None
    if apart is not None and 1.0 - apart**2 < AGREEMENT.level:
        yield _Finding(
            f"The fold models differ by {apart:.2g} standard deviations of the output: record "
            "longer."
        )


def _honesty(view: SearchView) -> _Findings:
    best, start = view.best, view.started
    if best is None or best.score is None:
        return
    again = view.refitted.again if view.refitted is not None else None
    errors = [f.diagnostics.train_error for f in best.result.folds] if best.result else []
    if words := unguarded(view):
        yield _Finding(words)
    if start.isolation == "process":
        yield _Finding("Candidates ran without isolation and could have read the held-out data.")
    if start.early_stopping == "validation":
        yield _Finding("Candidates saw their score on the held-out data during training.")
    if start.residuals == "held_out":
        yield _Finding("The agent saw held-out residuals.")
    if again is not None and (again.value is None or abs(again.value - 1.0) > REPEATED.level):
        yield _Finding("A second fit of the best candidate failed or gave another error.")
    if errors and consistency(best.score.value, errors) < HONEST.level:
        yield _Finding("The error on held-out data is far below that on training data.")
    if best.result is not None and best.result.deadline:
        yield _Finding(
            "The best candidate's fit reached its deadline, so it depends on the machine."
        )


def unguarded(view: SearchView) -> str:
    """Return why V alone stands for the result of a search; "" where it is evidence, or where
    guard records confirm it."""
    if not view.started.gate or view.started.guard_digest is not None:
        return ""
    return (
        "V alone proves little here: the agent could read the training records, and no guard "
        "records are held back to confirm it. Record more, or name some in data.guard."
    )


def alarms(view: SearchView) -> tuple[str, ...]:
    """Return what is said before everything else: a test error far above V, a gain that the guard
    records contradict, and a V that no model can have."""
    found: list[str] = []
    best = view.best
    if best is None or best.score is None:
        return ()
    value, named = best.score.value, model_to_use(view)
    if view.unsealed is not None and named is not None:
        model = tested_model(view.unsealed, named.model)
        error = model.error if isinstance(model, TestedModel) else None
        if error is not None and error > FAR_ABOVE_V * value > 0:
            found.append(
                f"the test error is {error / value:.3g} times V, far more than in honest searches "
                f"that went well ({FAR_ABOVE_V:g} at most): V is no measure of this model"
            )
    total = view.looks[-1].total if view.looks else None
    if total is not None and total.contradicted:
        since = f"since #{total.since:02d}" if total.since else "from the training mean"
        error = (
            f"but the model fails on the guard records ({total.detail})"
            if total.guard is None
            else f"the error on the guard records by {total.guard.value:.0%} (at most "
            f"{total.guard.high:.0%})"
        )
        found.append(f"V fell by {total.gain:.0%} {since}, {error}: V is no measure of this model")
    if view.truth is not None and view.below_truth(value):
        found.append(
            f"V {value:.4g} of #{best.number:02d} is below that of the simulated truth, "
            f"{view.truth:.4g}, which no model can reach: the candidate contains held-out data"
        )
    return tuple(found)
