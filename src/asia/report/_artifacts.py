"""Simulated outputs as a run recorded them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data import Array
from asia.ledger import Experiment, Run, Store, Unsealed
from asia.protocol import Fold


def fold_outputs(
    store: Store, experiment: Experiment, folds: Sequence[Fold]
) -> tuple[tuple[Array, ...], ...]:
    """Simulated held-out blocks (H, ny) of each fold, as the search recorded them."""
    assert experiment.result is not None
    return tuple(
        store.get_arrays(record.y_hat, [b.y.shape for b in fold.validation])
        for record, fold in zip(experiment.result.folds, folds, strict=True)
    )


def opened_windows(run: Run, opened: Unsealed, artifact: str) -> tuple[Array, ...]:
    """Test outputs of a protocol with windows, measured or simulated: one (horizon, ny) array a
    window."""
    assert opened.horizon is not None
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    rows = np.concatenate(run.store.get_arrays(artifact, shapes))
    return tuple(rows.reshape(-1, opened.horizon, len(opened.channels)))
