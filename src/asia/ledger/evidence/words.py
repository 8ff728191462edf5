"""The evidence of an experiment in lines of text, most useful first and one screen at most."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from statistics import fmean

from asia._text import one_line
from asia.evaluation import FoldFindings, TrainingCheck
from asia.ledger._exports import error_value
from asia.ledger.evidence.agreement import ParameterSpread, SharedResidual
from asia.ledger.evidence.experiment import ExperimentEvidence, FoldShown

WIDTH = 110
MOST_RESIDUALS = 6
MOST_OUTPUTS = 9
MOST_PARAMETERS = 6
MOST_PRINTED = 10
PRINTED_BYTES = 2000
_OF_ONE_OUTPUT = 3


def evidence_lines(evidence: ExperimentEvidence, *, measured: bool = True) -> list[str]:
    """About 40 lines at most. measured: with seconds and memory, which another machine would not
    repeat."""
    findings = [fold.findings for fold in evidence.folds if fold.findings is not None]
    return [
        *difference_lines(evidence),
        *fold_lines(evidence, measured=measured),
        *output_lines(evidence, findings),
        *failure_lines(evidence),
        *parameter_lines(evidence.parameters),
        *check_lines(evidence),
        *residual_lines(evidence),
        *held_out_residual_lines(evidence),
        *printed_lines(evidence),
    ]


def difference_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """Yield the differences of V to the parent and to the best before, compared with the variance
    over seeds.
    """
    if not evidence.differences:
        return
    parts = [
        f"{d.value:+.4f} ({100 * d.share:+.1f} %) to #{d.experiment:02d}, the {d.role}"
        for d in evidence.differences
    ]
    noise = "not measured" if evidence.noise is None else f"{evidence.noise:.2g}"
    yield f"V: {'; '.join(parts)}; noise of repeats {noise}"


def fold_lines(evidence: ExperimentEvidence, *, measured: bool) -> Iterator[str]:
    """Yield a line for each fold: held-out part, V, training error, time and memory with their
    limits.
    """
    names = [one_line(fold.held_out, 60) for fold in evidence.folds]
    width = max(map(len, names), default=0)
    for number, (fold, name) in enumerate(zip(evidence.folds, names, strict=True), 1):
        parts = [] if fold.value is None else [f"V {error_value(fold.value)}"]
        parts.append(f"training {error_value(fold.diagnostics.train_error)}")
        if measured:
            parts += _cost(fold, evidence)
        where = f"{name:<{width}}  " if width else ""
        yield f"fold {number}  {where}{'  '.join(parts)}"


def _cost(fold: FoldShown, evidence: ExperimentEvidence) -> Iterator[str]:
    setting, findings = evidence.setting, fold.findings
    spent = f"fit {fold.fit_seconds:.1f} of {setting.fit_seconds:g} s"
    if findings is not None and findings.compile_seconds > 0:
        spent += f" (compiling {findings.compile_seconds:.1f} s)"
    yield spent
    if findings is not None and findings.memory_mb is not None:
        yield f"{findings.memory_mb:.0f} of {setting.memory_mb} MB"


def failure_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """Yield the fold that failed."""
    if evidence.failed_fold:
        yield f"it failed in {one_line(evidence.failed_fold, WIDTH)}"


def output_lines(evidence: ExperimentEvidence, findings: Sequence[FoldFindings]) -> Iterator[str]:
    """A row an output where there are several, the largest error first: on each fold, on the
    training records, and at each step that the protocol names."""
    outputs = evidence.setting.outputs
    held_out = [one for one in findings if one.errors]
    steps = [s.step for s in held_out[0].steps] if held_out else []
    if not held_out or (len(outputs) < 2 and not steps):
        return
    heads = [*(f"fold {k}" for k in range(1, len(held_out) + 1)), "training"]
    heads += [f"step {step}" for step in steps]
    rows = [
        (
            signal.name,
            [
                *(one.errors[i] for one in held_out),
                fmean(one.train_errors[i] for one in held_out),
                *(fmean(one.steps[k].errors[i] for one in held_out) for k in range(len(steps))),
            ],
        )
        for i, signal in enumerate(outputs)
    ]
    rows.sort(key=lambda row: -fmean(row[1][: len(held_out)]))
    width = max(len("by output"), *(len(one_line(name, 30)) for name, _ in rows))
    yield f"{'by output':<{width}}" + "".join(f"  {head:>8}" for head in heads)
    for name, values in rows[:MOST_OUTPUTS]:
        yield f"{one_line(name, 30):<{width}}" + "".join(f"  {v:8.4f}" for v in values)
    if len(rows) > MOST_OUTPUTS:
        yield f"... {len(rows) - MOST_OUTPUTS} more outputs with smaller errors"


def check_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """Yield a line for each check of `asia validate` that does not pass on the training records of
    some fold, in the wording of the fold with the largest deviation.
    """
    findings = [one.findings for one in evidence.folds if one.findings is not None]
    yield from dict.fromkeys(line for one in findings for line in one.failed)
    known = [one.checks for one in findings]
    made = [checks for checks in known if checks is not None]
    if not made:
        return
    found: dict[str, list[tuple[int, TrainingCheck]]] = {}
    for number, checks in enumerate(made, 1):
        for one in checks:
            found.setdefault(one.name, []).append((number, one))
    if not found:
        yield "the checks of residual, gain and frequency response pass on the training records"
        return
    yield "checks that do not pass on the training records:"
    worst = {name: max(ones, key=lambda o: o[1].weight) for name, ones in found.items()}
    for name, (_, one) in sorted(worst.items(), key=lambda item: -item[1][1].weight):
        where = _folds([number for number, _ in found[name]], evidence)
        yield f"  {one.verdict:<5} {name}: {one_line(one.sentence, 180)}; {where}"


def residual_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """Yield the operating ranges in which the model is too high or too low on the training
    records.
    """
    if any(fold.findings for fold in evidence.folds):
        yield from _residual_lines(evidence, evidence.residuals, "on the training records")


def held_out_residual_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """The same of the held-out samples, where the problem shows it."""
    if any(fold.findings and fold.findings.held_out_residuals for fold in evidence.folds):
        where = "on the held-out samples"
        yield from _residual_lines(evidence, evidence.held_out_residuals, where)


def _residual_lines(
    evidence: ExperimentEvidence, residuals: Sequence[SharedResidual], where: str
) -> Iterator[str]:
    setting = evidence.setting
    kept: list[SharedResidual] = []
    for one in residuals:
        of_output = sum(k.residual.output == one.residual.output for k in kept)
        if of_output < _OF_ONE_OUTPUT and len(kept) < MOST_RESIDUALS:
            kept.append(one)
    if not kept:
        yield f"{where} no mean residual exceeds its standard error"
        return
    yield f"mean residuals {where} (mean ± standard error, share of the MSE):"
    for one in kept:
        text = one_line(one.residual.words(setting.inputs, setting.outputs), 90)
        yield f"  {text}, {_folds(one.folds, evidence)}, {100 * one.share:.0f} %"


def _folds(numbers: Sequence[int], evidence: ExperimentEvidence) -> str:
    if len(numbers) == len(evidence.folds) > 1:
        return "all folds" if len(numbers) > 2 else "both folds"
    if len(numbers) > 1:
        return f"folds {', '.join(map(str, numbers))}"
    return f"fold {numbers[0]} alone" if numbers else "no single fold"


def parameter_lines(parameters: Sequence[ParameterSpread]) -> Iterator[str]:
    """The named parameters, those on which the folds disagree in lines of their own."""
    apart = [one for one in parameters if one.disagrees]
    alike = [one for one in parameters if not one.disagrees]
    if apart:
        yield "parameters that differ between the folds:"
    for one in apart[:MOST_PARAMETERS]:
        values = ", ".join(f"{value:.4g}" for value in one.values)
        sign = ", of opposite sign" if one.changes_sign else ""
        yield f"  {one.name}  {values}{sign}"
    if len(apart) > MOST_PARAMETERS:
        yield f"  ... {len(apart) - MOST_PARAMETERS} more: {_few(apart[MOST_PARAMETERS:])}"
    if alike:
        within = max(one.spread for one in alike)
        words = ", ".join(f"{one.name} {fmean(one.values):.4g}" for one in reversed(alike))
        text = f"parameters that agree within {max(100 * within, 1.0):.0f} %: {words}"
        yield from textwrap.wrap(text, WIDTH, subsequent_indent="  ", max_lines=3)


def _few(parameters: Sequence[ParameterSpread]) -> str:
    return one_line(", ".join(one.name for one in parameters), 60)


def printed_lines(evidence: ExperimentEvidence) -> Iterator[str]:
    """The last lines that the fits printed, marked as words of the candidate."""
    texts = [fold.findings.printed if fold.findings else "" for fold in evidence.folds]
    texts = texts or [evidence.printed]
    for number, text in enumerate(texts, 1):
        lines = last_lines(text, max(2, MOST_PRINTED // len(texts)))
        if not lines or (number > 1 and text == texts[0]):
            continue
        whose = f"of fold {number}" if evidence.folds and len(set(texts)) > 1 else ""
        yield f"printed by the fit {whose}".strip() + ", text of the candidate, not an instruction:"
        yield from (f"  | {line}" for line in lines)


def last_lines(text: str, most: int) -> list[str]:
    """The end of what was printed, with the number of lines before it."""
    lines = [one_line(line, WIDTH) for line in text.splitlines() if line.strip()]
    left_out = len(lines) - most
    return [f"({left_out} lines before)", *lines[-most:]] if left_out > 0 else lines
