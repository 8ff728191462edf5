"""Statistics of repeated fits for a confirmation: ranks, differences, expected error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from asia.data import Array
from asia.evaluation import derive_seed
from asia.ledger import Confirmed, ConfirmedCandidate, ConfirmedPair, Repeated, SearchView
from asia.scoring import (
    ExpectedError,
    Interval,
    RepeatedFits,
    Score,
    corrected_level,
    expected_error,
    expected_of_ensemble,
    noise_of_seeds,
    paired_difference,
    value_interval,
)

LEVEL: Final = 0.95
EXPECTED_LEVEL: Final = 0.9


@dataclass(frozen=True)
class TriedCandidate:
    """A candidate with a score."""

    experiment: int
    """1-based."""
    first: RepeatedFits
    """The fit of the search."""
    repeats: tuple[Repeated, ...] = ()
    """Fits from other seeds; () of a candidate that was not repeated."""

    @property
    def deterministic(self) -> bool:
        """Return whether fits do not depend on the seed."""
        return any(repeat.same for repeat in self.repeats)

    @property
    def fits(self) -> RepeatedFits | None:
        """Fits that judge the candidate: those without influence on its choice, or the first if all
        are equal; None if all repeats failed.
        """
        if self.deterministic:
            return self.first
        sound = [(r.outcome, r.blocks) for r in self.repeats if isinstance(r.outcome, Score)]
        if not sound:
            return None
        values = np.array([[fold.value for fold in score.folds] for score, _ in sound])
        return RepeatedFits(values, even_blocks([blocks for _, blocks in sound]))


def rank(view: SearchView, tried: Sequence[TriedCandidate], top: int, seeds: int) -> Confirmed:
    """Rank the first `top` candidates by their repeats.

    Differences hold simultaneously over as many comparisons as a choice among all candidates makes,
    or over the pairs if these are more.
    """
    assert view.best is not None
    repeated = tried[:top]
    known = {c.experiment: c.fits for c in repeated}
    judged = {number: fits for number, fits in known.items() if fits is not None}
    order = sorted(judged, key=lambda number: (judged[number].value, number))
    count = max(len(tried) - 1, len(order) * (len(order) - 1) // 2)
    level = corrected_level(LEVEL, count)
    pairs = tuple(
        ConfirmedPair(a, b, paired_difference(judged[b], judged[a], level))
        for a, b in combinations(order, 2)
    )
    by_number = {candidate.experiment: candidate for candidate in repeated}
    winner = next(c.first for c in tried if c.experiment == view.best.number)
    blocks = even_blocks([_rows(candidate.first.blocks[0]) for candidate in tried])
    seed = derive_seed(view.started.seed, "confirm")
    # The expected error is that of the fit that is handed over, including the effect of its seed.
    expected = expected_error(winner, blocks, EXPECTED_LEVEL, seed)
    return Confirmed(
        winner=view.best.number,
        seeds=seeds,
        tried=len(tried),
        level=LEVEL,
        candidates=tuple(_ranked(by_number[n], judged[n], pairs, len(order)) for n in order),
        pairs=pairs,
        noise=_noise(repeated),
        expected=expected,
        expected_level=EXPECTED_LEVEL,
        ensemble=_of_ensemble(view, expected),
        failed=tuple(number for number, fits in known.items() if fits is None),
        after_unsealing=view.unsealing is not None,
    )


def _of_ensemble(view: SearchView, expected: ExpectedError) -> Interval | None:
    """Return the expected error of the ensemble; None if the search did not compare its fold models
    on the training records.
    """
    check = None if view.refitted is None else view.refitted.check
    if check is None or check.ensemble_error is None:
        return None
    errors = [error for error in check.fold_errors if error is not None]
    if len(errors) < len(check.fold_errors):
        return None
    return expected_of_ensemble(expected, errors, check.ensemble_error)


def even_blocks(each: Sequence[Sequence[Sequence[float]]]) -> Array:
    """Block values (fits, folds, blocks). Where a fold is so short that it has fewer blocks than
    another, all have as many as that."""
    fewest = min(len(fold) for one in each for fold in one)
    return np.array([[fold[:fewest] for fold in one] for one in each])


def _rows(blocks: Array) -> list[list[float]]:
    return blocks.tolist()


def _noise(repeated: Sequence[TriedCandidate]) -> float | None:
    """Over candidates whose fits depend on the seed; 0 where none does."""
    found = [c.fits for c in repeated if not c.deterministic]
    random = [fits for fits in found if fits is not None]
    return noise_of_seeds(random) if random else 0.0


def _ranked(
    candidate: TriedCandidate, fits: RepeatedFits, pairs: Sequence[ConfirmedPair], count: int
) -> ConfirmedCandidate:
    number, deterministic = candidate.experiment, candidate.deterministic
    failed = sum(not isinstance(r.outcome, Score) for r in candidate.repeats)
    return ConfirmedCandidate(
        experiment=number,
        first=candidate.first.value,
        value=value_interval(fits, LEVEL),
        spread=0.0 if deterministic else fits.spread,
        repeats=len(candidate.repeats) - failed,
        failed=failed,
        deterministic=deterministic,
        best_rank=1 + sum(pair.apart for pair in pairs if pair.second == number),
        worst_rank=count - sum(pair.apart for pair in pairs if pair.first == number),
    )
