"""Check that the model stays bounded far beyond the length of its records."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.scoring.dossier.check import Cause, Check, CheckCurve, Verdict

HORIZONS = 10
_FAR = 5.0
# Growth of the second five horizons over that of the first: an integrator has about 1.
_SPEEDS_UP = 2.0
_MORE = 1.5
_DRAWN = 2000


def check_long_run(y_hat: Array | None, lowest: Array, highest: Array) -> Check:
    """Check that a long simulation stays bounded.

    Args:
        y_hat: (HORIZONS * H, ny) simulated with a repeated input, or None where the outputs are
            not finite
        lowest, highest: (ny,) range of the training outputs
    """
    name, axes = "ten horizons", ("horizon", "distance over half the training range [-]")
    if y_hat is None:
        sentence = f"over ten horizons the simulation diverges: {Cause.UNSTABLE}"
        return Check(name, Verdict.FAIL, sentence, Cause.UNSTABLE, 3.0)
    half = np.maximum((highest - lowest) / 2.0, 1e-300)
    distance = np.max(np.abs(y_hat - (highest + lowest) / 2.0) / half, axis=1)
    peaks = np.array([part.max() for part in np.array_split(distance, HORIZONS)])
    step = max(1, len(distance) // _DRAWN)
    times = np.arange(len(distance))[::step] * HORIZONS / len(distance)
    curves = (CheckCurve("distance from the middle", times, distance[::step]),)
    last = float(peaks[-1])
    early, late = float(peaks[4] - peaks[0]), float(peaks[-1] - peaks[4])
    faster = late > _SPEEDS_UP * max(early, 0.05)
    if faster and last > _MORE * float(peaks[0]):
        words = f"over ten horizons the simulation grows exponentially, to {last:.3g} times"
        verdict = Verdict.FAIL if last > _FAR else Verdict.DOUBT
        return Check(name, verdict, f"{words} half the training range: {Cause.UNSTABLE}",
                     Cause.UNSTABLE, 3.0, curves, axes)  # fmt: skip
    if last > _FAR:
        sentence = (
            f"over ten horizons the simulation goes to {last:.3g} times half the training range, "
            "steadily, as an integrator does"
        )
        return Check(name, Verdict.DOUBT, sentence, None, 0.3, curves, axes)
    sentence = f"over ten horizons the simulation stays within {last:.2g} times half the training"
    return Check(name, Verdict.PASS, f"{sentence} range", curves=curves, axes=axes)
