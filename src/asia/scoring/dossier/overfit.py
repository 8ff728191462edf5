"""Whether the model does as well where it was not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.scoring.dossier.check import Cause, Check, CheckCurve, Verdict

# Mean held-out error over mean training error; and what the fold with the least must have.
_DOUBT, _FAIL, _EVERY = 1.5, 2.5, 1.2


def check_overfit(train: Sequence[float], held_out: Sequence[float]) -> Check:
    """train, held_out: the normalised error of each fold's model on the records that it was fitted
    to, and on what was held out."""
    a, b = np.array(train), np.array(held_out)
    ratio = float(b.mean() / max(float(a.mean()), 1e-300))
    least = float(np.min(b / np.maximum(a, 1e-300)))
    folds = np.arange(1, len(a) + 1, dtype=np.float64)
    curves = (CheckCurve("training", folds, a), CheckCurve("held out", folds, b))
    words = (
        f"the error is {ratio:.2f} times that of the fit ({b.mean():.3g} against {a.mean():.3g})"
    )
    axes = ("fold", "normalised error [-]")
    if ratio < _DOUBT or least < _EVERY:
        return Check("held-out error", Verdict.PASS, f"on held-out samples {words}",
                     curves=curves, axes=axes)  # fmt: skip
    verdict = Verdict.FAIL if ratio >= _FAIL else Verdict.DOUBT
    sentence = f"on held-out samples {words}: {Cause.OVERFIT}"
    return Check("held-out error", verdict, sentence, Cause.OVERFIT, 1.0 - 1.0 / ratio,
                 curves, axes)  # fmt: skip
