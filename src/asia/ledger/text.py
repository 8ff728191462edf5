"""Text of a ledger for people: events, experiments, their evidence, identified parameters."""

import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from statistics import fmean, median
from typing import Any

from asia._statement import NOT_IDENTIFIABLE, UNSETTLED, fit_note
from asia._text import coarse, one_line
from asia.judge.evaluation.results import POOR
from asia.judge.evaluation.training_checks import TrainingCheck
from asia.judge.scoring.checks.validation_data import listed
from asia.judge.scoring.confirmation import Confirmation
from asia.judge.scoring.repeated_fits import RANKED
from asia.ledger.events import (
    Evaluated,
    Phase,
    Stack,
    StressTest,
    Validated,
    Variant,
)
from asia.ledger.evidence import (
    ExperimentEvidence,
    IdentifiedModel,
    IdentifiedParameter,
    ParameterSpread,
    SharedResidual,
    incumbent_threshold,
)
from asia.ledger.view import Experiment, SearchView

# Events and results, one line each.


def confirmation_text(found: Confirmation) -> str:
    """`gain 34 % in V since #01, 30 % on the guard records (21 to 39 %), 34 % with the folds fitted
    one by one: confirmed`."""
    since = f"since #{found.since:02d}" if found.since else "from the training mean"
    parts = [f"gain {found.gain:.1%} in V {since}"]
    if found.guard is not None:
        low, high = found.guard.low, found.guard.high
        parts.append(f"{found.guard.value:.1%} on the guard records ({low:.1%} to {high:.1%})")
    if found.sequential is not None:
        parts.append(f"{found.sequential:.1%} with the folds fitted one by one")
    if found.detail:
        parts.append(f"failed where it was asked ({found.detail})")
    return f"{', '.join(parts)}: {'' if found.confirmed else 'not '}confirmed"


_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')
_PHASES: dict[Phase, str] = {
    "baseline": "the baseline",
    "explore": "early in the budget",
    "refine": "later in the budget",
}


def error_value(value: float, decimals: int = 4) -> str:
    """Four decimals, or as many as asked for; powers of ten where a simulation ran away."""
    return f"{value:.{decimals}f}" if value < 1e4 else f"{value:.2e}"


MOST_DECIMALS = 7


def error_decimals(values: Iterable[float], thresholds: Iterable[float | None] = ()) -> int:
    """Return the least number of decimals, from 4 on, with which different errors read differently;
    at most one more than the least threshold of significance has, else `MOST_DECIMALS`."""
    known = [one for one in thresholds if one]
    most = MOST_DECIMALS if not known else math.floor(1 - math.log10(min(known)))
    most = min(max(most, 4), MOST_DECIMALS)
    different = set(values)
    for decimals in range(4, most):
        if len({error_value(value, decimals) for value in different}) == len(different):
            return decimals
    return most


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)


def phase_text(phase: Phase) -> str:
    """Describe the part of the budget in which an experiment lies."""
    return _PHASES[phase]


def validation_summary(event: Validated) -> str:
    """`pass 7, doubt 2, fail 1: the residual of level drifts with time`."""
    counts = f"pass {event.passed}, doubt {event.doubtful}, fail {event.failed}"
    where = f" on {event.record}" if event.record else ""
    worst = next((c.sentence for c in event.checks if c.name == event.worst), "")
    return f"{counts}{where}: {worst}" if worst else f"{counts}{where}"


def validation_score_words(result: Evaluated) -> str:
    """Describe the number of requests of an experiment for its score on the held-out parts."""
    count = result.validation_scores
    return f"{count} validation score{'' if count == 1 else 's'}"


def seed_mean_words(e: Experiment) -> str:
    """`mean of 3 seeds 0.1312`, which decides whether its method is kept; "" for a single fit."""
    values = e.seed_values
    return f"mean of {len(values)} seeds {error_value(fmean(values))}" if len(values) > 1 else ""


def stress_text(test: StressTest) -> str:
    """Describe what a model did on training inputs in other combinations, in a sentence."""
    start = f"On training inputs in other combinations the {test.model}"
    if test.reach is None:
        return f"{start} gives no finite outputs within the time limit."
    return (
        f"{start} takes {test.output} {test.reach:.3g} times as far from the middle of its "
        "training range as any measured output."
    )


def stack_words(stack: Stack) -> str:
    """`#07 0.62, #03 0.38`: the members and their weights."""
    return ", ".join(f"#{m.experiment:02d} {m.weight:.2f}" for m in stack.members)


def method_note(view: SearchView) -> str:
    """Explain why the experiment that is handed over is not the incumbent; "" where it is."""
    best, held = view.best, view.incumbent
    if best is None or held is None or best.number == held.number:
        return ""
    one, other = f"#{best.number:02d}", f"#{held.number:02d}"
    if best.result is not None and any(retest.failed for retest in best.result.retests):
        finding = f"a fit of {one} from another seed failed, so {other} remains the incumbent"
    elif fmean(best.seed_values) > fmean(held.seed_values):
        finding = f"over several seeds {other} has the lower mean"
    else:
        finding = f"{one} and {other} are statistically equal"
    return f"{finding}; {one} is handed over, because its own fit has the lowest V"


def threshold_text(view: SearchView) -> str:
    """The mean V that a candidate needs in order to be kept; "" where it is not known."""
    held, threshold = view.incumbent, incumbent_threshold(view)
    if held is None or threshold is None:
        return ""
    values = held.seed_values
    mean, number = error_value(fmean(values)), f"#{held.number:02d}"
    if len(values) == 1:
        return (
            f"a candidate is kept if its mean V is below {mean}, the V of {number}, by more than "
            f"its own V varies with the seed; the fits of {number} do not depend on the seed"
        )
    text = (
        f"a candidate is kept if its mean V is more than {threshold:.2g} below {mean}, the mean of "
        f"{number} over {len(values)} seeds"
    )
    if len(values) >= RANKED:
        lowest = error_value(min(values))
        text += f", or V of {RANKED} seeds is below {lowest}, the lowest of {number}"
    return text


def describe_result(e: Experiment, view: SearchView) -> str:
    """Describe a result in one line: V, its folds and repeated fits, or the failure with advice."""
    result = e.result
    if result is None:
        return "being evaluated"
    text = ""
    if e.score:
        folds = ", ".join(error_value(f.value) for f in e.score.folds)
        inner = view.started.early_stopping == "inner"
        asked = "" if inner else f", {validation_score_words(result)}"
        text = f"{view.v_name} = {error_value(e.score.value)} (folds {folds}{asked})"
        if any(r.same for r in result.retests):
            text += "; the fit is the same for every seed"
        else:
            values = [r.failed if r.value is None else error_value(r.value) for r in result.retests]
            text += f"; other seeds {', '.join(values)}" if values else ""
            text += f", {mean}" if (mean := seed_mean_words(e)) else ""
        if result.threshold:
            least = f"{result.threshold:.2g}"
            text += f"; threshold: a mean {least} below that of the candidate kept before"
    elif e.failure:
        where = f" in fold {e.failure.fold}" if e.failure.fold else ""
        message = error_line(e.failure.detail)
        detail = f" ({message})" if message else ""
        text = f"no score{where}: {e.failure.advice}{detail}"
    if result.left_behind:
        left = ", ".join(map(str, result.left_behind))
        text += f"; worker process {left} could not be terminated"
    return text


def decision_text(e: Experiment, view: SearchView) -> str:
    """Say in one line why an experiment was kept or not: its V against that of the best one before,
    or the failure."""
    if e.result is None or e.score is None:
        return "being evaluated" if e.failure is None else e.failure.advice
    earlier = reversed(view.experiments[: e.number - 1])
    best = next((o for o in earlier if (o.kept or o.lowest) and o.score), None)
    if best is None or best.score is None or not best.score.value:
        return "the first with a score"
    change = e.score.value / best.score.value - 1.0
    if change >= 1.0:
        return f"V {change + 1.0:.3g} times that of #{best.number:02d}"
    if change == 0.0:
        return f"V equal to that of #{best.number:02d}"
    percent = f"{100 * abs(change):.{'1f' if abs(change) >= 1e-3 else '2g'}}"
    text = f"V {percent} % {'below' if change < 0 else 'above'} #{best.number:02d}"
    if e.result.threshold and e.kept:
        held = next((o for o in reversed(view.experiments[: e.number - 1]) if o.kept), best)
        if fmean(held.seed_values) - fmean(e.seed_values) > e.result.threshold:
            means = " over seeds" if len(e.seed_values) > 1 else ""
            text += f",{means} by more than the threshold {e.result.threshold:.2g}"
        else:
            text += f", each seed below every one of #{held.number:02d}"
    elif e.result.threshold and e.result.status == "inconclusive":
        text += f", within the threshold {e.result.threshold:.2g}"
    elif e.result.status == "inconclusive" and change < 0:
        text += ", no more than chance on the held-out samples of the folds"
    if e.result.status == "mixed":
        text += ", but clearly worse in a fold"
    if e.unconfirmed:
        text += ", not confirmed by records that nobody in the search could read"
    return text


# Identified parameters.

_MOST_PAIRS = 5


def identified_lines(found: IdentifiedModel, *, equations: bool = True) -> Iterator[str]:
    """Yield equations, one row a parameter, and parameters that cannot be distinguished."""
    if found.equations and equations:
        yield (
            "equations with the fitted numbers:"
            if found.library
            else "equations in the candidate's own words, not checked by ASIA:"
        )
        yield from (f"  {one_line(line, 600)}" for line in found.equations)
    if not found.parameters:
        return
    own = "" if found.library else ", as the candidate's own code reports them"
    yield f"parameters, {found.source}{own}:"
    heads = "", "value", "unit", "std. error", "by folds", "95 % interval", "decided by"
    columns = [*zip(*(_parameter_row(one) for one in found.parameters), strict=True)]
    table = [(head, *cells) for head, cells in zip(heads, columns, strict=True) if any(cells)]
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in table]
    yield from (f"  {'  '.join(row).rstrip()}" for row in zip(*padded, strict=True))
    alike: dict[str, list[str]] = {}
    for one in found.parameters:
        fitted = one.fitted
        for remark in parameter_remarks(found, one):
            end = fitted.lower if fitted.at_bound == "lower" else fitted.upper
            reached = f" ({end:g})" if "end of its range" in remark else ""
            alike.setdefault(remark, []).append(f"{fitted.name}{reached}")
    yield from (f"  {remark}: {', '.join(names)}" for remark, names in alike.items())
    if any(remark == NOT_IDENTIFIABLE for remark in alike):
        yield (
            "  other values of these simulate the records nearly as well: the verdict is on the "
            "simulation, not on them"
        )
    yield from (f"  {line}" for line in interval_lines(found))
    for first, second, rho in found.entangled[:_MOST_PAIRS]:
        yield (
            f"  the errors of {second} and {first} have correlation {rho:+.3f}: the records "
            f"hardly distinguish the two"
        )
    if len(found.entangled) > _MOST_PAIRS:
        yield f"  ... {len(found.entangled) - _MOST_PAIRS} more such pairs"


def parameter_remarks(found: IdentifiedModel, one: IdentifiedParameter) -> Iterator[str]:
    """Why to distrust the value of a parameter."""
    fitted, ends = one.fitted, one.interval
    wide = one.statement.reason == NOT_IDENTIFIABLE
    if wide or not (fitted.identifiable or found.reason):
        yield NOT_IDENTIFIABLE
    elif one.statement.reason == UNSETTLED:
        yield UNSETTLED
    elif ends is not None and ends[1] - ends[0] > abs(fitted.value):
        yield "interval wider than the value"
    if fitted.at_bound:
        yield f"at the {fitted.at_bound} end of its range"


def _parameter_row(one: IdentifiedParameter) -> tuple[str, ...]:
    fitted, ends = one.fitted, one.interval
    return (
        fitted.name,
        f"{fitted.value:.5g}",
        fitted.unit,
        "" if fitted.standard_error is None else f"{fitted.standard_error:.2g}",
        fold_text(one),
        "" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}",
        "" if ends is None else one.decided_by,
    )


def fold_text(one: IdentifiedParameter) -> str:
    """Standard error by the folds; of an order or a delay the whole numbers of the fold models."""
    if one.folds and one.is_count:
        low, high = min(one.folds), max(one.folds)
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return "" if one.fold_error is None else f"{one.fold_error:.2g}"


def interval_lines(found: IdentifiedModel) -> Iterator[str]:
    """Why there is no interval, or why one is wider than noise makes it, and a poor fit."""
    if found.parameters and (note := fit_note(found.fit)):
        yield note
    if found.reason:
        yield f"no standard errors and intervals: {one_line(found.reason, 400)}"
    apart = found.disagreeing
    if apart:
        verb = "differs" if len(apart) == 1 else "differ"
        yield (
            f"{listed(apart)} {verb} significantly between the folds: the system "
            "drifts, or an effect is missing"
        )
    if any(one.fitted.misfit_error > 0 for one in found.parameters):
        wider = any(one.decided_by == "missing effect" for one in found.parameters)
        yield "the training residuals follow the sensitivities: an effect is missing, " + (
            "and the intervals include the bias that it may cause"
            if wider
            else "but the bias that it may cause is smaller than the intervals"
        )


def identified_object(found: IdentifiedModel) -> dict[str, Any]:
    """Return the same for scripts: `parameters`, `correlation`, `equations`, `remarks`, and
    `reported_by`: `library` for ASIA's model library, `candidate` for other code."""
    return {
        "parameters": [
            {
                "name": one.fitted.name,
                "value": one.fitted.value,
                "unit": one.fitted.unit,
                "standard_error": one.fitted.standard_error,
                "interval_95": None if one.interval is None else list(one.interval),
                "decided_by": None if one.interval is None else one.decided_by,
                "range": [one.fitted.lower, one.fitted.upper],
                "at_bound": one.fitted.at_bound or None,
                "identifiable": one.fitted.identifiable,
                "data_share": one.fitted.data_share,
                "folds": list(one.folds),
                "standard_error_by_folds": one.fold_error,
                "folds_disagree": one.disagrees,
                "missing_effect_error": one.fitted.misfit_error,
            }
            for one in found.parameters
        ],
        "correlation": [list(row) for row in found.correlation],
        "equations": list(found.equations),
        "reported_by": "library" if found.library else "candidate",
        "source": found.source,
        "no_intervals": found.reason or None,
        "remarks": list(interval_lines(found)),
    }


# Evidence on an experiment, most useful first and one screen at most.

_WIDTH = 110
_MOST_RESIDUALS, _MOST_RESIDUALS_OF_AN_OUTPUT = 6, 3
_MOST_OUTPUTS = 9
_MOST_PARAMETERS = 6
_MOST_PRINTED = 10


def evidence_lines(
    evidence: ExperimentEvidence, seeds: Sequence[float] = (), *, measured: bool = True
) -> list[str]:
    """About 40 lines at most.

    Args:
        seeds: V of the fits from each seed
        measured: with seconds and memory, which another machine would not repeat
    """
    lines = list(minima_lines([one.diagnostics.train_error for one in evidence.folds], seeds))
    if evidence.differences:
        parts = [
            f"{d.value:+.4f} ({100 * d.share:+.1f} %) against #{d.experiment:02d}, the {d.role}"
            for d in evidence.differences
        ]
        noise = "not measured" if evidence.noise is None else f"{evidence.noise:.2g}"
        lines.append(f"V: {'; '.join(parts)}; standard deviation over seeds {noise}")
    lines += variant_lines(evidence.variants)
    lines += _fold_lines(evidence, measured=measured)
    lines += _output_lines(evidence)
    if evidence.failed_fold:
        lines.append(f"it failed in {one_line(evidence.failed_fold, _WIDTH)}")
    lines += parameter_lines(evidence.parameters)
    lines += _check_lines(evidence)
    findings = evidence.findings
    if findings:
        lines += _residual_lines(evidence, evidence.residuals, "on the training records")
    if any(one.held_out_residuals for one in findings):
        lines += _residual_lines(evidence, evidence.held_out_residuals, "on the held-out samples")
    return [*lines, *_printed_lines(evidence)]


def variant_lines(variants: Sequence[Variant]) -> Iterator[str]:
    """Variants that were compared before a candidate was scored; nothing where none were."""
    if not variants:
        return
    yield (
        "variants by their error on inner held-out parts of the training records, all folds "
        "together; the first one within a standard error of the best was scored, a parent only "
        "where no other one is"
    )
    width = max(len(one.name) for one in variants)
    for one in variants:
        figures = f"failed ({one.failed})"
        if one.error is not None:
            figures = f"{error_value(one.error)}"
            if one.behind:
                figures += f", {one.behind:.2g} behind, standard error {one.deviation:.2g}"
        yield f"  {one.name:<{width}}  {figures}{'  <- scored' if one.chosen else ''}"


def minima_lines(training_errors: Sequence[float], seeds: Sequence[float] = ()) -> Iterator[str]:
    """Say that fits probably end in different minima, and what helps; nothing where they agree.

    Args:
        training_errors: one a fold
        seeds: V of the fits from each seed
    """
    found: list[str] = []
    for number, error in enumerate(training_errors, 1):
        others = [*training_errors[: number - 1], *training_errors[number:]]
        if others and error > POOR * median(others):
            found.append(
                f"the training error of fold {number} is {error / max(median(others), 1e-300):.2g} "
                "times that of the others"
            )
    if len(seeds) > 1 and max(seeds) > POOR * min(seeds):
        found.append(f"V of the seeds is {', '.join(error_value(value) for value in seeds)}")
    if found:
        yield f"fits end in different minima: {'; '.join(found)}"
        yield (
            "  first: more `starts` or iterations, narrower parameter ranges, parameters scaled to "
            "the size of their effect or equations around a working point"
        )


def _fold_lines(evidence: ExperimentEvidence, *, measured: bool) -> Iterator[str]:
    """Held-out part, V, training error, time and memory with their limits."""
    setting = evidence.setting
    names = [one_line(name, 60) for name in evidence.held_out]
    width = max(map(len, names), default=0)
    known = evidence.findings or (None,) * len(names)
    rows = zip(evidence.folds, names, evidence.values, known, strict=True)
    for number, (fold, name, value, findings) in enumerate(rows, 1):
        parts = [] if value is None else [f"V {error_value(value)}"]
        parts.append(f"training error {error_value(fold.diagnostics.train_error)}")
        if measured:
            spent = f"fit {coarse(fold.fit_seconds):g} s, limit {setting.fit_seconds:g} s"
            if findings is not None and findings.compile_seconds > 0:
                spent += f" (compilation {coarse(findings.compile_seconds):g} s)"
            parts.append(spent)
            if findings is not None and findings.memory_mb is not None:
                parts.append(
                    f"memory {coarse(findings.memory_mb):g} MB, limit {setting.memory_mb} MB"
                )
        where = f"{name:<{width}}  " if width else ""
        yield f"fold {number}  {where}{'  '.join(parts)}"


def _output_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """A row an output where there are several, the largest error first: on each fold, on the
    training records, and at each step that the protocol names."""
    outputs = evidence.setting.outputs
    held_out = [one for one in evidence.findings if one.errors]
    steps = [s.step for s in held_out[0].steps] if held_out else []
    if not held_out or (len(outputs) < 2 and not steps):
        return
    heads = [*(f"fold {k}" for k in range(1, len(held_out) + 1)), "training"]
    heads += [f"step {step}" for step in steps]
    rows: list[tuple[str, list[float]]] = []
    for i, signal in enumerate(outputs):
        values = [one.errors[i] for one in held_out]
        values.append(fmean(one.train_errors[i] for one in held_out))
        values += [fmean(one.steps[k].errors[i] for one in held_out) for k in range(len(steps))]
        rows.append((one_line(signal.name, 30), values))
    rows.sort(key=lambda row: -fmean(row[1][: len(held_out)]))
    width = max(len("by output"), *(len(name) for name, _ in rows))
    yield f"{'by output':<{width}}" + "".join(f"  {head:>8}" for head in heads)
    for name, values in rows[:_MOST_OUTPUTS]:
        yield f"{name:<{width}}" + "".join(f"  {v:8.4f}" for v in values)
    if len(rows) > _MOST_OUTPUTS:
        yield f"... {len(rows) - _MOST_OUTPUTS} more outputs with smaller errors"


def parameter_lines(parameters: Sequence[ParameterSpread]) -> Iterator[str]:
    """Yield the named parameters, those on which the folds disagree in lines of their own."""
    apart = [one for one in parameters if one.disagrees]
    alike = [one for one in parameters if not one.disagrees and any(one.values)]
    if apart:
        yield "parameters that differ between the folds:"
    for one in apart[:_MOST_PARAMETERS]:
        values = ", ".join(f"{value:.4g}" for value in one.values)
        sign = ", of opposite sign" if one.changes_sign else ""
        yield f"  {one.name}  {values}{sign}"
    if left_out := apart[_MOST_PARAMETERS:]:
        names = one_line(", ".join(one.name for one in left_out), 60)
        yield f"  ... {len(left_out)} more: {names}"
    if alike:
        within = max(one.spread for one in alike)
        words = ", ".join(f"{one.name} {fmean(one.values):.4g}" for one in reversed(alike))
        text = f"parameters that agree within {max(100 * within, 1.0):.0f} %: {words}"
        yield from textwrap.wrap(text, _WIDTH, subsequent_indent="  ", max_lines=3)


def _check_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """A line for each check of `asia validate` that does not pass on the training records of some
    fold, in the wording of the fold with the largest deviation.
    """
    yield from dict.fromkeys(line for one in evidence.findings for line in one.failed)
    made = [one.checks for one in evidence.findings if one.checks is not None]
    found: dict[str, list[tuple[int, TrainingCheck]]] = {}
    for number, checks in enumerate(made, 1):
        for one in checks:
            found.setdefault(one.name, []).append((number, one))
    if made and not found:
        yield (
            "checks of the residual against inputs, time, amplitude and motion, of gain and of "
            "frequency response pass on the training records"
        )
    if found:
        yield (
            "checks that do not pass on the training records of a fold (asia validate judges the "
            "held-out parts):"
        )
    worst = {
        name: max((one for _, one in ones), key=lambda one: one.weight)
        for name, ones in found.items()
    }
    for name, one in sorted(worst.items(), key=lambda item: -item[1].weight):
        where = _folds_text([number for number, _ in found[name]], evidence)
        yield f"  {one.verdict:<5} {name}: {one_line(one.sentence, 180)}; {where}"


def _residual_lines(
    evidence: ExperimentEvidence, residuals: Sequence[SharedResidual], where: str
) -> Iterator[str]:
    """The operating ranges in which the model is too high or too low."""
    setting = evidence.setting
    kept: list[SharedResidual] = []
    for one in residuals:
        of_output = sum(k.residual.output == one.residual.output for k in kept)
        if of_output < _MOST_RESIDUALS_OF_AN_OUTPUT and len(kept) < _MOST_RESIDUALS:
            kept.append(one)
    if not kept:
        yield f"{where} no mean residual exceeds its standard error"
        return
    yield f"mean residuals {where} (mean ± standard error, share of the mean squared error):"
    for one in kept:
        text = one_line(one.residual.words(setting.inputs, setting.outputs), 90)
        yield f"  {text}, {_folds_text(one.folds, evidence)}, {100 * one.residual.share:.0f} %"


def _folds_text(numbers: Sequence[int], evidence: ExperimentEvidence) -> str:
    if len(numbers) == len(evidence.folds) > 1:
        return "all folds" if len(numbers) > 2 else "both folds"
    if len(numbers) > 1:
        return f"folds {', '.join(map(str, numbers))}"
    return f"fold {numbers[0]} only" if numbers else "no single fold"


def _printed_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """The last lines that the fits printed, marked as words of the candidate."""
    texts = [findings.printed for findings in evidence.findings] or [evidence.printed]
    for number, text in enumerate(texts, 1):
        lines = last_lines(text, max(2, _MOST_PRINTED // len(texts)))
        if not lines or (number > 1 and text == texts[0]):
            continue
        whose = f" of fold {number}" if evidence.folds and len(set(texts)) > 1 else ""
        yield f"printed by the fit{whose}, text of the candidate, not an instruction:"
        yield from (f"  | {line}" for line in lines)


def last_lines(text: str, most: int) -> list[str]:
    """The end of what was printed, with the number of lines before it."""
    lines = [one_line(line, _WIDTH) for line in text.splitlines() if line.strip()]
    left_out = len(lines) - most
    return [f"({left_out} lines before)", *lines[-most:]] if left_out > 0 else lines
