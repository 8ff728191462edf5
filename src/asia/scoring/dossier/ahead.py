"""Errors some steps after a start from measured samples, against holding the last output."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.scoring.dossier.check import Check, CheckCurve, Verdict

_NAME, _AXES = "steps ahead", ("steps after the start", "normalised error [-]")
_WORST_TENTH = 0.9


def check_ahead(model: Array, hold: Array | None, deviation: Array) -> Check:
    """model, hold (n, K, ny): errors of n simulations that begin anew, and of the last measured
    output, at steps 1 to K; hold is None where a simulation begins without measured outputs;
    deviation (ny,) of the outputs."""
    size = _sizes(model, deviation)
    each = np.sqrt(np.mean((model / deviation) ** 2, axis=2))
    steps = np.arange(1, model.shape[1] + 1, dtype=np.float64)
    curves = [
        CheckCurve("model", steps, size),
        CheckCurve("model, worst tenth", steps, np.quantile(each, _WORST_TENTH, axis=0)),
    ]
    shown = dict.fromkeys(k for k in (1, 5, 20, len(steps)) if k <= len(steps))
    words = ", ".join(f"{size[k - 1]:.3g} at step {k}" for k in shown)
    sentence = (
        f"normalised error after a start from measured samples: {words}; over all steps "
        f"{_spread(each)}"
    )
    if hold is None:
        return Check(_NAME, Verdict.SHOWN, f"{sentence}; there is no measured output before the "
                     "first sample to hold", curves=tuple(curves), axes=_AXES)  # fmt: skip
    held = _sizes(hold, deviation)
    curves.append(CheckCurve("last output", steps, held))
    worse = bool(size[-1] >= held[-1])
    if worse:
        sentence += f"; holding the last output has {held[-1]:.3g} at step {len(steps)}"
    verdict = Verdict.DOUBT if worse else Verdict.PASS
    return Check(_NAME, verdict, sentence, None, 0.2, tuple(curves), _AXES)


def no_steps_ahead(why: str) -> Check:
    """Return a check that does not apply, where no window starts anew."""
    return Check(_NAME, Verdict.ABSENT, f"does not apply: {why}")


def _sizes(errors: Array, deviation: Array) -> Array:
    return np.sqrt(np.mean((errors / deviation) ** 2, axis=(0, 2)))


def _spread(each: Array) -> str:
    """each (n, K): the normalised error of each simulation."""
    whole = np.sqrt(np.mean(each**2, axis=1))
    middle, far = np.quantile(whole, (0.5, _WORST_TENTH)).tolist()
    return (
        f"{middle:.3g} in the middle of {len(whole)} starts, {far:.3g} or more in the worst tenth, "
        f"{float(whole.max()):.3g} at most"
    )
