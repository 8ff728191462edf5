"""Errors some steps after a start from measured samples, against holding the last output."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.scoring.dossier.check import Check, CheckCurve, Verdict


def check_ahead(model: Array, hold: Array, deviation: Array) -> Check:
    """model, hold (n, K, ny): errors of n simulations that begin anew, and of the last measured
    output, at steps 1 to K; deviation (ny,) of the outputs."""
    sizes = [np.sqrt(np.mean((e / deviation) ** 2, axis=(0, 2))) for e in (model, hold)]
    steps = np.arange(1, model.shape[1] + 1, dtype=np.float64)
    curves = tuple(
        CheckCurve(n, steps, s) for n, s in zip(("model", "last output"), sizes, strict=True)
    )
    shown = dict.fromkeys(k for k in (1, 5, 20, len(steps)) if k <= len(steps))
    words = ", ".join(f"{sizes[0][k - 1]:.3g} at step {k}" for k in shown)
    sentence = f"normalised error after a start from measured samples: {words}"
    worse = bool(sizes[0][-1] >= sizes[1][-1])
    if worse:
        sentence += f"; holding the last output has {sizes[1][-1]:.3g} at step {len(steps)}"
    verdict = Verdict.DOUBT if worse else Verdict.PASS
    return Check("steps ahead", verdict, sentence, None, 0.2, curves,
                 ("steps after the start", "normalised error [-]"))  # fmt: skip
