"""Evidence on an experiment, most useful first and one screen at most."""

import textwrap
from collections.abc import Iterator, Sequence
from statistics import fmean, median

from asia._text import coarse, one_line
from asia.judge.scoring.checks.check import RecordedCheck
from asia.judge.scoring.outcome import POOR
from asia.ledger.events import Variant
from asia.ledger.evidence import (
    ComparedScore,
    ExperimentEvidence,
    ParameterSpread,
    SharedResidual,
    compared_scores,
    evidence_of,
    settings_of_run,
)
from asia.ledger.run import Run
from asia.ledger.view import Experiment, SearchView
from asia.presentation.table import error_value

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
        noise = "not measured" if evidence.noise is None else f"{evidence.noise:.2g}"
        text = _comparison(evidence.differences)
        lines.append(f"V: {text}; standard deviation over seeds {noise}")
    lines += variant_lines(evidence.variants)
    lines += _fold_lines(evidence, measured=measured)
    lines += _output_lines(evidence)
    if evidence.failed_fold:
        lines.append(f"it failed in {one_line(evidence.failed_fold, _WIDTH)}")
    lines += parameter_lines(evidence.parameters)
    lines += _check_lines(evidence)
    if any(one.findings for one in evidence.folds):
        lines += _residual_lines(evidence, evidence.residuals, "on the training records")
    if any(one.held_out_residuals for one in evidence.folds):
        lines += _residual_lines(evidence, evidence.held_out_residuals, "on the held-out samples")
    return [*lines, *_printed_lines(evidence)]


def _comparison(differences: Sequence[ComparedScore]) -> str:
    return "; ".join(
        f"{d.value:+.4f} ({100 * d.share:+.1f} %) against #{d.experiment:02d}, the {d.role}"
        for d in differences
    )


def comparison_facts(e: Experiment, view: SearchView) -> Iterator[tuple[str, str]]:
    """Yield V of an experiment less V of its parent and of the best one before, with a label."""
    if differences := compared_scores(e, view):
        yield "V", _comparison(differences)


def recorded_evidence(run: Run, e: Experiment) -> list[str]:
    """Return the evidence on an experiment of a run; [] without a result or without artifacts."""
    if e.result is None or not run.store.kept:
        return []
    found = evidence_of(e, run.view, run.store, settings_of_run(run.directory))
    return evidence_lines(found, e.seed_values) if found.recorded else []


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
    rows = zip(evidence.folds, names, evidence.values, strict=True)
    for number, (fold, name, value) in enumerate(rows, 1):
        parts = [] if value is None else [f"V {error_value(value)}"]
        parts.append(f"training error {error_value(fold.diagnostics.train_error)}")
        if measured:
            spent = f"fit {coarse(fold.fit_seconds):g} s, limit {setting.fit_seconds:g} s"
            if fold.compile_seconds > 0:
                spent += f" (compilation {coarse(fold.compile_seconds):g} s)"
            parts.append(spent)
            if fold.memory_mb is not None:
                parts.append(f"memory {coarse(fold.memory_mb):g} MB, limit {setting.memory_mb} MB")
        where = f"{name:<{width}}  " if width else ""
        yield f"fold {number}  {where}{'  '.join(parts)}"


def _output_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """A row an output where there are several, the largest error first: on each fold, on the
    training records, and at each step that the protocol names."""
    outputs = evidence.setting.outputs
    held_out = [one for one in evidence.folds if one.errors]
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
    yield from dict.fromkeys(line for one in evidence.folds for line in one.failed)
    made = [one.checks for one in evidence.folds if one.checks is not None]
    found: dict[str, list[tuple[int, RecordedCheck]]] = {}
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
    texts = [fold.printed for fold in evidence.folds] or [evidence.printed]
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
