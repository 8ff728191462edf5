"""Bands of a final model, from the held-out simulations that the ledger keeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.evaluation import Evaluator
from asia.ledger import Experiment, SearchView, Store, Use
from asia.protocol import Case, Fold
from asia.scoring import (
    Bands,
    ErrorSizes,
    HeldOutErrors,
    Region,
    error_sizes,
    output_bands,
    region_of,
)
from asia.search.final.members import FinalMember, final_members

BAND_LEVEL = 0.9
"""Coverage of the bands that are drawn and recorded."""

# Share of the differences between the fold models. Held-out errors already contain the variance
# of a fold model; the full differences would count it twice.
_SHARE = 0.5


@dataclass(frozen=True)
class BandBasis:
    """Data for the output bands of one final model."""

    errors: tuple[HeldOutErrors, ...]
    """Held-out errors of the fold models behind the model, NaN for unmeasured outputs."""
    simulated: tuple[tuple[Array, ...], ...]
    """Their simulations (H, ny) of each held-out block, one tuple a fold."""
    region: Region
    """Region of all training records."""
    windows: bool
    """True if the protocol simulates windows, so that errors depend on the step."""

    @cached_property
    def _sizes(self) -> ErrorSizes:
        return error_sizes(self.errors, by_step=self.windows)

    def around(
        self, case: Case, folds: Array, y_hat: Array, level: float
    ) -> tuple[Bands, NDArray[np.bool_]]:
        """Bands at the level, and whether each sample (H,) is outside the region of validity,
        where the bands are wider in proportion to the distance. folds: the simulations (K, H, ny)
        of the fold models; y_hat (H, ny) that of the final model, which the bands always hold."""
        centres = y_hat + _SHARE * (folds - folds.mean(axis=0))
        distance = self.region.distance(case.past_u, case.u, y_hat)
        wider = np.maximum(distance, 1.0)
        found = output_bands(self._sizes, centres, level, wider)
        bands = Bands(np.minimum(found.lower, y_hat), np.maximum(found.upper, y_hat))
        return bands, distance > 1.0


def models_behind(view: SearchView, use: Use) -> tuple[FinalMember, ...]:
    """The fold models that say how wrong a final model is: of a stack its members', otherwise the
    winner's."""
    return final_members(view, "stack" if use == "stack" else "ensemble")


def band_basis(evaluator: Evaluator, view: SearchView, store: Store, use: Use) -> BandBasis:
    """The basis for the bands of a final model that the search has."""
    if use == "stack" and view.refitted is not None and view.refitted.stack is not None:
        weights = {m.experiment: m.weight for m in view.refitted.stack.members}
    else:
        assert view.best is not None
        weights = {view.best.number: 1.0}
    parts = [(view.experiment(number), weight) for number, weight in weights.items()]
    simulated = tuple(_simulated(fold, parts, store) for fold in evaluator.folds)
    errors = tuple(
        HeldOutErrors(tuple(b.y - y for b, y in zip(fold.validation, y_hat, strict=True)))
        for fold, y_hat in zip(evaluator.folds, simulated, strict=True)
    )
    region = region_of([(r.u, r.y) for r in evaluator.records])
    return BandBasis(errors, simulated, region, evaluator.horizon is not None)


def _simulated(
    fold: Fold, parts: Sequence[tuple[Experiment, float]], store: Store
) -> tuple[Array, ...]:
    """The weighted simulations of what a fold holds out."""
    shapes = [block.y.shape for block in fold.validation]
    total = [np.zeros(shape) for shape in shapes]
    for experiment, weight in parts:
        assert experiment.result is not None
        kept = store.get_arrays(experiment.result.folds[fold.index].y_hat, shapes)
        for sum_, y_hat in zip(total, kept, strict=True):
            sum_ += weight * y_hat
    return tuple(total)
