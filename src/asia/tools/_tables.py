"""What `tools.py` prints: scores, parameters, residuals, correlations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asia.data import Array
from asia.problem.load import Problem
from asia.protocol import Block, find_metric
from asia.scoring import (
    SignedResidual,
    combine,
    cross_correlation,
    independent_band,
    white_band,
)
from asia.tools._local import LocalFold

_MOST_RESIDUALS = 8
_MOST_LAG = 20


def tables(
    problem: Problem, folds: Sequence[LocalFold], *, whole: bool, held_out: bool
) -> Iterator[str]:
    """Lines about a candidate; whole: whether these are all folds of V; held_out: with the
    residuals of the held-out part."""
    yield from _scores(problem, folds, whole=whole)
    yield from _parameters(folds)
    for part in (False, True) if held_out else (False,):
        yield from _residuals(problem, folds, held_out=part)
    yield from _correlations(problem, folds)


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
            said = ", ".join(
                f"{s.name} {e:.4g} {metric.unit_of(s.unit)}".rstrip() for s, e in errors
            )
            yield f"    {metric.label}: {said}"


def _parameters(folds: Sequence[LocalFold]) -> Iterator[str]:
    found = [one.parameters for one in folds]
    names = list(dict.fromkeys(name for one in found for name in one))
    if not names:
        return
    yield ("parameters" + "".join(f"{f'{_name(one)}':>14}" for one in folds) + "    spread")
    wide = max(len(name) for name in names)
    for name in names:
        values = [one.get(name, np.nan) for one in found]
        size = float(np.mean(np.abs(values)))
        spread = f"{np.ptp(values) / size:9.0%}" if size > 0 and len(values) > 1 else "        -"
        yield f"  {name:<{wide}}" + "".join(f"{v:14.6g}" for v in values) + spread


def _residuals(problem: Problem, folds: Sequence[LocalFold], *, held_out: bool) -> Iterator[str]:
    where = "held-out" if held_out else "training"
    yield f"signed residuals, {where} part (s.d. of the output; notable ones)"
    for one in folds:
        notable = [r for r in one.residuals(held_out=held_out) if r.notable][:_MOST_RESIDUALS]
        for residual in notable:
            yield f"  {_name(one)}: {_words(problem, residual)}"
        if not notable:
            yield f"  {_name(one)}: none"


def _words(problem: Problem, residual: SignedResidual) -> str:
    return f"{residual.words(problem.inputs, problem.outputs)} ({residual.share:.0%} of the error)"


def _correlations(problem: Problem, folds: Sequence[LocalFold]) -> Iterator[str]:
    yield f"correlation of training residuals, lags to {_MOST_LAG} samples"
    for one in folds:
        lags = max(1, min(_MOST_LAG, min(len(block.y) for block in one.training) // 4))
        for k, output in enumerate(problem.outputs):
            e = _column(one.training, one.training_y_hat, k)
            yield f"  {_name(one)}, {output.name}: " + _line(problem, one, e, lags)


def _line(problem: Problem, one: LocalFold, e: Sequence[Array], lags: int) -> str:
    own = cross_correlation(e, e, lags)[lags:]
    band = white_band(sum(len(r) for r in e))
    beyond = np.flatnonzero(np.abs(own) < band)
    length = int(beyond[0]) if len(beyond) else lags
    longer = " or more" if not len(beyond) else ""
    said = [
        f"own past {own[1] if lags else 0:.2f} at lag 1, above the band for {length}{longer} lags"
    ]
    for i, signal in enumerate(problem.inputs):
        u = [b.case.u[:, i] for b in one.training]
        values = cross_correlation(e, u, lags)
        place = int(np.argmax(np.abs(values)))
        limit = independent_band(e, u, lags)
        mark = " above the band" if abs(values[place]) > limit else ""
        said.append(f"{signal.name} {values[place]:.2f} at lag {place - lags}{mark}")
    return "; ".join(said)


def _name(one: LocalFold) -> str:
    return f"fold {one.fold.index + 1}"


def _column(blocks: Sequence[Block], y_hat: Sequence[Array], output: int) -> list[Array]:
    pairs = zip(blocks, y_hat, strict=True)
    return [block.y[:, output] - simulated[:, output] for block, simulated in pairs]
