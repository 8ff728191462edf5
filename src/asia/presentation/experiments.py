"""Experiments of a search: story, result, decision, what is compared with them."""

import re
from collections.abc import Iterable, Iterator, Sequence
from statistics import fmean
from typing import Any

from asia._text import one_line
from asia._timer import duration
from asia.judge.scoring.confirmation import Confirmation
from asia.judge.scoring.outcome import SUSPICIOUS_RATIO, Outcome, Score, consistency
from asia.judge.scoring.repeated_fits import RANKED
from asia.ledger.events import Evaluated, Phase, ReferenceScored, StressTest
from asia.ledger.evidence import incumbent_threshold
from asia.ledger.view import Experiment, SearchView
from asia.presentation.table import Block, Table, error_decimals, error_value
from asia.problem.metrics import metric_label


def experiment_facts(e: Experiment, view: SearchView) -> Iterator[tuple[str, str]]:
    """Yield the story of an experiment: what was tried and why, result and decision; labels with
    texts."""
    p, result = e.proposed, e.result
    parent = f", derived from #{p.parent:02d}" if p.parent else ""
    yield "changed", f"{p.family}, {_PHASES[p.phase]}{parent}"
    if p.agent:
        yield "agent", p.agent
    yield "hypothesis", p.hypothesis
    yield "expected", p.expected
    if p.remark:
        yield "remark", p.remark
    yield "result", describe_result(e, view)
    if result is None:
        return
    reason = f": {decision_text(e, view)}" if e.score else ""
    yield "decision", f"{result.status}{reason}"
    if result.confirmation is not None:
        yield "confirmation", confirmation_text(result.confirmation)
    yield "duration", duration(result.seconds)
    yield from (("note", line) for line in result.failed_checks)


def experiment_line(experiment: Experiment, view: SearchView) -> str:
    """`#07 keep  V=0.1310  min fit 87.2 % ... | best #07 0.1310`: one greppable line, with the
    lowest fit index over folds and outputs, that ends with the lowest V at that time. With
    validation early stopping it says how many validation scores were given.

    V is that of one fit on both sides. A candidate that was fitted from several seeds has a mean as
    well, which decides what is kept: `... | mean of 3 seeds 0.1422 | best #04 0.0890, lowest mean
    of seeds #07 0.1422`."""
    r, proposed = experiment.result, experiment.proposed
    assert r is not None
    if isinstance(r.outcome, Score):
        fits = [f.worst_fit for f in r.outcome.folds if f.worst_fit is not None]
        worst = min(fits, default=None)
        fit = "   -  " if worst is None else f"{worst:5.1f} %" if worst > -999 else "<-999 %"
        found = f"V={error_value(r.outcome.value)}  min fit {fit}"
    else:
        found = f"{r.outcome.reason.value:<24}"
    mean = seed_mean_words(experiment)
    best = next((e for e in reversed(view.bests) if e.number <= experiment.number), None)
    tail = "best none"
    if best and best.score:
        tail = f"best #{best.number:02d} {error_value(best.score.value)}"
        kept = [e for e in view.finished if e.kept and e.number <= experiment.number]
        if kept and (mean or kept[-1].number != best.number):
            value = error_value(fmean(kept[-1].seed_values))
            several = "lowest mean of seeds" if len(kept[-1].seed_values) > 1 else "kept"
            tail += f", {several} #{kept[-1].number:02d} {value}"
    asked = "" if view.started.early_stopping == "inner" else f" | {_validation_scores(r):<21}"
    # As wide as `inconclusive` with its figures.
    outcome = f"{r.status:<7} {found}"
    return (
        f"#{experiment.number:02d} {outcome:<38}  {duration(r.seconds):>6}  "
        f"{proposed.title:<44}{asked}{f' | {mean}' if mean else ''} | {tail}"
    )


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


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)


def stress_text(test: StressTest) -> str:
    """Describe what a model did on training inputs in other combinations, in a sentence."""
    start = f"On training inputs in other combinations the {test.model}"
    if test.reach is None:
        return f"{start} gives no finite outputs within the time limit."
    return (
        f"{start} takes {test.output} {test.reach:.3g} times as far from the middle of its "
        "training range as any measured output."
    )


def _validation_scores(result: Evaluated) -> str:
    count = result.validation_scores
    return f"{count} validation score{'' if count == 1 else 's'}"


def seed_mean_words(e: Experiment) -> str:
    """`mean of 3 seeds 0.1312`, which decides whether its method is kept; "" for a single fit."""
    values = e.seed_values
    return f"mean of {len(values)} seeds {error_value(fmean(values))}" if len(values) > 1 else ""


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
        asked = "" if inner else f", {_validation_scores(result)}"
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


def experiments_table(experiments: Sequence[Experiment], view: SearchView) -> Table:
    """Return V of experiments of a search, and its change to the best one before."""
    rows: list[list[Any]] = []
    decimals = error_decimals_of(view.finished)
    for e in experiments:
        before = next((o.value for o in reversed(view.bests) if o.number < e.number), None)
        change = (e.value - before) / before if e.value is not None and before else None
        status = e.result.status if e.result else "running"
        rows.append([e.number, e.proposed.title, e.value, change, status])
    columns = {
        "experiment": "number", "candidate": "", view.v_name: f"error:{decimals}",
        "change of V": "signed_share", "decision": "",
    }  # fmt: skip
    return Table("experiments; change of V to the best one before", columns, rows)


def error_decimals_of(experiments: Iterable[Experiment]) -> int:
    """Number of decimals with which the V of these experiments read differently."""
    scored = [
        (e.value, e.result.threshold) for e in experiments if e.result and e.value is not None
    ]
    return error_decimals(*zip(*scored, strict=True)) if scored else 4


def references_table(view: SearchView) -> Table:
    """Return V of the reference models."""
    rows: list[list[Any]] = []
    for one in view.references:
        rows.append([one.name, value_text(one.outcome), reference_note(one)])
    return Table("reference models", {"reference": "", view.v_name: "error", "note": ""}, rows)


def reference_note(one: ReferenceScored) -> str:
    """Describe a reference model; "" where its name says it all."""
    if one.structure is not None:
        return "order {}, delay {} samples".format(*one.structure)
    return "the true system: the noise floor" if one.name == "simulated truth" else ""


def references_text(view: SearchView) -> str:
    """`last output held 1.5364, linear model 0.1082`: V of the reference models."""
    each = (f"{one.name} {value_text(one.outcome)}" for one in view.references)
    return one_line(", ".join(each), 1000)


def value_text(outcome: Outcome) -> str:
    """V, or the reason of the failure."""
    return error_value(outcome.value) if isinstance(outcome, Score) else outcome.reason.value


_MOST_OUTPUTS_AS_COLUMNS = 3


def fold_blocks(e: Experiment, view: SearchView, metric: str) -> Iterator[Block]:
    """Yield the results of the folds of an experiment that has a score: errors and fit index on
    the held-out part, the training error, and the residuals on the training records."""
    score, result, outputs = e.score, e.result, view.started.outputs
    assert score is not None
    assert result is not None
    label = metric_label(metric)
    errors = [fold.per_channel(metric) for fold in score.folds]
    fits = [fold.fit_index for fold in score.folds]
    columns = {"fold": "", "V": "error"}
    few = len(outputs) <= _MOST_OUTPUTS_AS_COLUMNS
    for name in outputs if few else ():
        columns |= {f"{label} {name}": "sig", f"fit {name}": "percent"}
    columns |= {
        "training error": "error",
        "validation scores": "",
        "fit time [s]": "sig:3",
    }
    rows: list[list[Any]] = []
    residuals: list[list[Any]] = []
    for k, (fold, record) in enumerate(zip(score.folds, result.folds, strict=True)):
        # The block says nothing that the samples do not.
        part = re.sub(r"^block \d+ of \d+: (?=samples)", "", "".join(view.started.folds[k : k + 1]))
        by_output = zip(errors[k], fits[k], strict=True) if few else ()
        found = record.diagnostics
        rows.append([
            f"{k + 1}: {part}" if part else f"{k + 1}",
            fold.value,
            *(value for pair in by_output for value in pair),
            found.train_error,
            record.validation_scores or None,
            record.fit_seconds,
        ])  # fmt: skip
        residuals.append([
            f"{k + 1}", found.bias, found.whiteness, found.input_correlation, found.top_error,
            found.start_error,
        ])  # fmt: skip
    yield Table(
        "results of the folds, on the held-out part",
        columns,
        rows,
    )
    if not few:
        heads = dict.fromkeys([f"fold {k}" for k in range(1, len(rows) + 1)], "sig")
        each = zip(outputs, *errors, strict=True)
        yield Table(f"{label} by output", {"output": "", **heads}, [*each])
        each = zip(outputs, *fits, strict=True)
        heads = dict.fromkeys(heads, "percent")
        yield Table("fit index by output", {"output": "", **heads}, [*each])
    yield Table(
        "residuals on the training records, of the worst output",
        {"fold": "", "mean": "sig:2", "own past": "fixed", "past inputs": "fixed",
         "highest tenth": "fixed", "first 5 %": "fixed"},
        residuals,
    )  # fmt: skip
    yield (
        "fit: 100 (1 - |y - y_hat| / |y - mean of y|); training error: scaled as V; mean: in "
        "standard deviations of the output; own past, past inputs: largest correlation; highest "
        "tenth of the output, first 5 % of a record: RMS over that of all samples"
    )
    for k, record in enumerate(result.folds, 1):
        if record.attempt:
            yield (
                f"fold {k}: the training error of the first fit was far above those of the other "
                f"folds; the fit from seed {record.attempt + 1} fits the fold's own data best"
            )
    ratio = consistency(score.value, [one.diagnostics.train_error for one in result.folds])
    text = f"V divided by the training error: {ratio:.2f}"
    if ratio < SUSPICIOUS_RATIO:
        text += ", suspiciously low"
        if result.status == "keep":
            text += "; V was the same when the folds were fitted again, one at a time"
    yield text
