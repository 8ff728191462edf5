"""Tables of a finished search: repeated fits, ablation, validation, final models, sealed test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure
from asia.ledger.events import (
    Ablated,
    Confirmed,
    Fit,
    RefitCheck,
    Refitted,
    Stack,
    Unsealed,
    Use,
    Validated,
)
from asia.ledger.run import final_models
from asia.presentation.table import Block, Table, error_value
from asia.problem.metrics import metric_label

# Repeated fits of the best candidates.


def confirmation_blocks(
    found: Confirmed, v_name: str = "V", experiment: int | None = None
) -> Iterator[Block]:
    """Yield candidates, differences, expected error and verdict. experiment: only what is about
    it; nothing if it was not repeated."""
    rows = [
        (
            one.experiment,
            " to ".join(dict.fromkeys((f"{one.best_rank}", f"{one.worst_rank}"))),
            one.value,
            one.first,
            one.repeats,
            "fits do not depend on the seed" if one.deterministic else one.spread,
            one.failed or None,
        )
        for one in found.candidates
        if experiment in (None, one.experiment)
    ]
    columns = {
        "experiment": "number", "rank": "", f"{v_name} over the seeds": "interval:error",
        "in the search": "error", "seeds": "", "standard deviation": "sig:2", "failed": "",
    }  # fmt: skip
    if rows:
        yield Table("fitted again from other seeds", columns, rows)
    for number in found.failed if experiment is None else ():
        yield f"#{number:02d} failed with every seed: not ranked"
    pairs = [
        (
            f"#{one.first:02d} and #{one.second:02d}",
            one.difference,
            f"#{one.first:02d} is better" if one.apart else "statistically equal",
        )
        for one in found.pairs
        if experiment in (None, one.first, one.second)
    ]
    if pairs:
        columns = {"pair": "", f"difference of {v_name}": "interval:signed_error", "verdict": ""}
        yield Table("differences of the candidates", columns, pairs)
    if experiment is None:
        if pairs:
            yield (
                f"all intervals hold together at {100 * found.level:.0f} %; they are corrected for "
                f"the {found.tried} candidates of the search"
            )
        yield f"variance over seeds: {noise_text(found)}"
    if found.expected is not None and experiment in (None, found.best):
        columns = {
            "model": "", f"scaled as {v_name}": "error",
            f"{100 * found.expected_level:.0f} % interval": "",
        }  # fmt: skip
        each = [("one fold model", found.expected), ("ensemble", found.ensemble)]
        yield Table(
            f"expected error of #{found.best:02d} on a new record of the same kind, as long as a "
            "fold",
            columns,
            [
                (name, one.value, f"{error_value(one.low)} to {error_value(one.high)}")
                for name, one in each
                if one is not None
            ],
        )
        yield (
            f"it includes {found.expected.optimism:.2g} for the selection from {found.tried} "
            "candidates"
        )
    if experiment is None:
        yield confirmation_verdict(found)
        if found.after_unsealing:
            yield AFTER_UNSEALING


AFTER_UNSEALING = "computed after the sealed test was opened; it was not used"


def confirmation_verdict(found: Confirmed) -> str:
    """Return the verdict on the best candidate in one sentence."""
    best = f"#{found.best:02d}"
    if not found.candidates or found.best in found.failed:
        return f"{best} is not confirmed: it failed with every other seed"
    if all(one.experiment != found.best for one in found.candidates):
        return f"{best} is not confirmed: it was not repeated"
    equal = [
        pair.first if pair.second == found.best else pair.second
        for pair in found.pairs
        if not pair.apart and found.best in (pair.first, pair.second)
    ]
    if not equal and found.candidates[0].experiment == found.best:
        if len(found.candidates) == 1:
            return f"{best} was the only candidate repeated: there is no comparison"
        return f"{best} is confirmed: it is better than all other repeated candidates"
    better = [p.first for p in found.pairs if p.second == found.best and p.apart]
    if better:
        names = " and ".join(f"#{number:02d}" for number in better)
        return f"{best} is not confirmed: {names} {'is' if len(better) == 1 else 'are'} better"
    names = " and ".join(f"#{number:02d}" for number in equal)
    return f"{best} and {names} are statistically equal: prefer the simplest of them"


def noise_text(found: Confirmed) -> str:
    """Return the standard deviation of V over seeds."""
    if found.noise is None:
        return "not known: needs two seeds with a score"
    if found.noise == 0.0:
        return "0, because the fits do not depend on the seed"
    return f"standard deviation of V {found.noise:.2g}"


# The gain of the best candidate in parts.


def ablation_blocks(found: Ablated, v_name: str) -> Iterator[Block]:
    """Yield the causes of the gain, and the contribution of each change."""
    crossing = found.crossing
    if crossing is None:
        yield f"model and training cannot be crossed: {found.detail}"
    else:
        parts = (
            ("its model, with the training of the baseline", crossing.model),
            ("its training, with the model of the baseline", crossing.training),
            ("interaction of both", crossing.interaction),
            ("in all", crossing.gain),
        )
        yield Table(
            f"gain of the best candidate #{found.best:02d} over the baseline",
            {"part": "", f"{v_name} is lower by": "interval:signed_error", "share": "share"},
            [(name, part, crossing.share(part)) for name, part in parts],
        )
    if found.left_out:
        yield Table(
            "changes of the lineage, each left out",
            {"without the change of": "number", f"{v_name} is higher by": "interval:signed_error"},
            [(one.experiment, one.detail if one.loss is None else one.loss)
             for one in found.left_out],
        )  # fmt: skip


# The validation of the model to use.


def validation_text(found: Validated) -> str:
    """`pass 7, doubt 2, fail 1: the residual of level drifts with time`."""
    counts = f"pass {found.passed}, doubt {found.doubtful}, fail {found.failed}"
    where = f" on {found.record}" if found.record else ""
    worst = next((c.sentence for c in found.checks if c.name == found.worst), "")
    return f"{counts}{where}: {worst}" if worst else f"{counts}{where}"


def validation_blocks(found: Validated) -> Iterator[Block]:
    """Yield what was checked, the result, and whether the sealed test had been opened."""
    model = f"the {found.model} of experiment {found.experiment}"
    if found.record:
        what = f"{model}, on {found.record}"
    else:
        what = (
            f"fold models of experiment {found.experiment} on the held-out parts of the training "
            f"records, small steps and long runs of the {found.model}"
        )
    yield f"checked: {what}; the sealed test was not used"
    yield validation_text(found)
    if found.after_unsealing:
        yield AFTER_UNSEALING


# The final models of a search.


_USES: dict[Use, str] = {
    "ensemble": "the ensemble, the mean of the models of all folds",
    "refit": "the refit, the best candidate fitted to all training records",
    "stack": "the stack, a weighted mean of several candidates",
}


def use_text(use: Use, refitted: Refitted | None) -> str:
    """Describe a final model."""
    if use == "refit" and refitted is not None and refitted.fold:
        return f"the model of fold {refitted.fold} of the best candidate, in place of a refit"
    return _USES[use]


def stack_text(stack: Stack, v_name: str = "V") -> str:
    """`V=0.1234 (nested cross-validation), weights #07 0.62, #03 0.38`."""
    weights = ", ".join(f"#{m.experiment:02d} {m.weight:.2f}" for m in stack.members)
    return f"{v_name}={error_value(stack.value)} (nested cross-validation), weights {weights}"


def second_fit_text(again: Fit) -> str:
    """Say what a second fit of a fold of the best candidate gave."""
    found = f"failed ({again.failed})"
    if again.value == 1.0:
        found = "gave the same result"
    elif again.value is not None:
        found = f"has {again.value:.4g} times the error of the first: V varies over repeated fits"
    return f"a second fit of fold {again.fold} {found}"


def final_models_table(check: RefitCheck, fold: int = 0) -> Table:
    """Return the error of each final model, and its difference from the ensemble. fold: the one
    whose model takes the place of a refit."""
    rows: list[tuple[str, float | str | None, float | None]] = []
    for k, value in enumerate(check.fold_errors, 1):
        name = f"model of fold {k}" + (", in place of a refit" if k == fold else "")
        rows.append((name, "no answer" if value is None else value, None))
    if check.ensemble_error is not None:
        rows.append(("ensemble", check.ensemble_error, None))
    for k, start in enumerate(check.starts, 1):
        name = "refit" if check.kept == k else "refit, not used"
        name += f" ({start.failed})" if start.failed else ""
        value = "no answer" if start.value is None else start.value
        rows.append((name, value, start.disagreement))
    columns = {
        "model": "",
        "scaled error on the training records": "error",
        "difference from the ensemble, in standard deviations of the output": "error",
    }
    return Table("final models", columns, rows)


# The sealed test.


def sealed_test_blocks(opened: Unsealed, use: Use | None, *, total: bool = True) -> Iterator[Block]:
    """Yield the errors on the sealed test, and the share of it inside the output bands.

    Args:
        use: the model to use
        total: false to leave out an error over all records, where official figures are of one
    """
    how = ""
    if opened.horizon is not None:
        how = f", in windows of {opened.horizon} samples"
    elif opened.skip:
        how = f", the first {opened.skip} samples of each record left out"
    yield (
        f"experiment #{opened.experiment:02d} on the sealed test, which this run opened once, "
        f"after its search{how}"
    )
    final = final_models(opened)
    models = {
        f"{key} (to use)" if key == use else key: model
        for key, model in final.items()
        if not isinstance(model, Failure)
    }
    several = len(opened.trajectories) > 1
    figures = dict.fromkeys(models, "sig")
    for k, score in enumerate(next(iter(models.values())).scores if models else ()):
        label, scores = metric_label(score.metric), [m.scores[k] for m in models.values()]
        rows: list[list[Any]] = [
            [name, *(one.per_channel[c] for one in scores)]
            for c, name in enumerate(opened.channels)
        ]
        if len(opened.channels) > 1:
            rows.insert(0, ["mean over the outputs", *(one.value for one in scores)])
        if total or not several:
            caption = f"{label} on the sealed test, in the unit of the output"
            yield Table(caption, {"output": "", **figures}, rows)
        if several:
            rows = [
                [name, *(one.per_trajectory[i] for one in scores)]
                for i, name in enumerate(opened.trajectories)
            ]
            yield Table(f"{label} on each test record", {"record": "", **figures}, rows)
    for key, model in final.items():
        if isinstance(model, Failure):
            # What breaks the contract says more itself.
            own = model.detail if model.reason is Reason.CONTRACT else ""
            yield f"no score for the {key}: {own or model.advice}"
    for name, model in models.items():
        if model.mee is not None:
            groups = model.mee.by_group()
            yield Table(
                f"mean Euclidean error after so many samples, {name}",
                {"outputs": "", **dict.fromkeys(next(iter(groups.values())), "sig")},
                [(group, *row.values()) for group, row in groups.items()],
            )
    if (bands := opened.bands) is not None:
        share = f"share inside the {100 * bands.level:.0f} % bands of the {bands.model}"
        pairs = [*zip(opened.channels, bands.covered, strict=True)]
        yield Table("output bands on the sealed test", {"output": "", share: "share"}, pairs)
        if bands.outside > 0.0:
            yield f"{100 * bands.outside:.1f} % of the samples are outside the region of validity"
