"""Tables of `tools.py`: scores, parameters, residuals, correlations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asia.data import Array
from asia.problem.load import Problem
from asia.protocol import Block, find_metric
from asia.scoring import (
    Evidence,
    SignedResidual,
    combine,
    with_input,
    with_own_past,
    without_gaps,
)
from asia.tools._local import LocalFold

_MOST_RESIDUALS = 8


def tables(
    problem: Problem, folds: Sequence[LocalFold], *, whole: bool, held_out: bool
) -> Iterator[str]:
    """Lines about a candidate; whole: whether these are all folds of V; held_out: with the
    residuals of the held-out part."""
    yield from _scores(problem, folds, whole=whole)
    yield from _parameters(folds)
    for part in (False, True) if held_out else (False,):
        yield from _residuals(problem, folds, held_out=part)
    yield from _correlations(problem, folds, held_out=held_out)


def _scores(problem: Problem, folds: Sequence[LocalFold], *, whole: bool) -> Iterator[str]:
    metric = find_metric(problem.protocol.metric)
    name = "V" if whole else f"{metric.v_label}, folds of your own or not all of them"
    value = combine([one.score for one in folds]).value
    yield f"{name} = {value:.6f}"
    limit = problem.budget.fit_seconds
    for one in folds:
        ratio = one.score.value / one.training_score.value
        late = f"  ABOVE THE LIMIT of {limit:g} s" if one.seconds > limit else ""
        yield (
            f"  {_name(one)}: {one.score.value:.6f}, training {one.training_score.value:.6f} "
            f"(ratio {ratio:.2f}), fit {one.seconds:.1f} s{late}"
        )
        if len(problem.outputs) > 1:
            errors = zip(problem.outputs, one.score.per_channel(metric.name), strict=True)
            message = ", ".join(
                f"{s.name} {e:.4g} {metric.unit_of(s.unit)}".rstrip() for s, e in errors
            )
            yield f"    {metric.label}: {message}"


def _parameters(folds: Sequence[LocalFold]) -> Iterator[str]:
    found = [one.parameters for one in folds]
    names = list(dict.fromkeys(name for one in found for name in one))
    if not names:
        return
    wide = max(len("parameters") - 2, *(len(name) for name in names))
    yield (
        f"{'parameters':<{wide + 2}}" + "".join(f"{_name(one):>14}" for one in folds) + "   spread"
    )
    for name in names:
        values = [one.get(name, np.nan) for one in found]
        size = float(np.mean(np.abs(values)))
        spread = f"{np.ptp(values) / size:9.0%}" if size > 0 and len(values) > 1 else "        -"
        yield f"  {name:<{wide}}" + "".join(f"{v:14.6g}" for v in values) + spread


def _residuals(problem: Problem, folds: Sequence[LocalFold], *, held_out: bool) -> Iterator[str]:
    where = "held-out" if held_out else "training"
    yield f"signed residuals, {where} part (mean ± standard error in s.d. of the output)"
    for one in folds:
        listed = [r for r in one.residuals(held_out=held_out) if r.evidence is not Evidence.NONE]
        listed.sort(key=lambda r: r.evidence is Evidence.CHANCE)
        for residual in listed[:_MOST_RESIDUALS]:
            yield f"  {_name(one)}: {_words(problem, residual)}"
        if not listed:
            yield f"  {_name(one)}: no mean residual exceeds its standard error"


def _words(problem: Problem, residual: SignedResidual) -> str:
    return f"{residual.words(problem.inputs, problem.outputs)} ({residual.share:.0%} of the error)"


def _correlations(problem: Problem, folds: Sequence[LocalFold], *, held_out: bool) -> Iterator[str]:
    """Yield the correlations as the picture draws them: all folds together, the held-out part if it
    is shown.
    """
    part = "held-out" if held_out else "training"
    yield f"correlation of the residuals, {part} part, all folds together, 99 % bands"
    blocks = [b for one in folds for b in (one.fold.validation if held_out else one.training)]
    y_hat = [y for one in folds for y in (one.y_hat if held_out else one.training_y_hat)]
    for k, output in enumerate(problem.outputs):
        yield f"  {output.name}: {_line(problem, blocks, _column(blocks, y_hat, k))}"


def _line(problem: Problem, blocks: Sequence[Block], e: Sequence[Array]) -> str:
    own = with_own_past(e)
    beyond = np.flatnonzero(np.abs(own.values) < own.band)
    length = int(beyond[0]) if len(beyond) else own.lags[-1]
    longer = " or more" if not len(beyond) else ""
    message = [f"own past {own.values[1]:.2f} at lag 1, above the band for {length}{longer} lags"]
    for i, signal in enumerate(problem.inputs):
        found = with_input(e, [b.case.u[:, i] for b in blocks])
        place = int(np.argmax(np.abs(found.values)))
        largest = float(found.values[place])
        side = "above" if abs(largest) > found.band else "within"
        message.append(
            f"{signal.name} {largest:.2f} at lag {found.lags[place]}, {side} the band of "
            f"{found.band:.2f}"
        )
    return "; ".join(message)


def _name(one: LocalFold) -> str:
    return f"fold {one.fold.index + 1}"


def _column(blocks: Sequence[Block], y_hat: Sequence[Array], output: int) -> list[Array]:
    pairs = zip(blocks, y_hat, strict=True)
    return [(without_gaps(b.y, found) - found)[:, output] for b, found in pairs]
