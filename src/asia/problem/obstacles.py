"""Why no model beats the mean of the outputs, by the training records, and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, log

from asia.data.statistics import acts, delays, feedback_size, integrating, largest_pole, unstable
from asia.data.trajectory import MOST_DELAY, Trajectory


def least_delay(records: Sequence[Trajectory]) -> int:
    """Samples after which an input acts first; 0 where no effect is seen."""
    found = [d.lag for row in delays(records) for d in row if d is not None and d.lag is not None]
    return min(found, default=0)


def obstacle(records: Sequence[Trajectory], horizon: int | None, past: int, best: str) -> str:
    """Describe the likely cause in the training records, and the remedy.

    Args:
        horizon: samples of a window; None where whole records are simulated
        past: samples of the past window
        best: number and V of the best candidate, " (best V 1.02 of #03)"
    """
    pole, loop, late = largest_pole(records), feedback_size(records), least_delay(records)
    diverges = unstable(records)
    if horizon is not None:
        advice = (
            f"Shorter windows than {horizon} samples, or a longer past window than {past} samples, "
            "make the task easier."
        )
    else:
        # As long as an error needs to grow tenfold.
        most = min(ceil(log(10.0) / log(pole)) if diverges else 50, 200)
        advice = (
            'Use kind = "windows" in [protocol]: each simulation then starts from measured outputs '
            f"(horizon = {most} or less)."
        )
    if diverges:
        held = ": a control loop stabilises it" if loop else ""
        follow = f" and the inputs follow the past outputs{held}" if loop else ""
        cause = f"the plant is unstable (a pole of modulus {pole:.4g}){follow}. {advice}"
    elif loop:
        cause = (
            f"the inputs follow the past outputs (correlation {loop:.2f}): the records come from a "
            "closed loop, and the outputs follow unmeasured disturbances. "
            f"{advice} Or excite the set point and record it as an input."
        )
    elif not acts(records):
        cause = (
            "no input and no squared input has a significant effect on an output. Check that "
            "inputs and outputs are synchronised, that the inputs vary enough, and that the input "
            f"that drives the plant is recorded. {advice}"
        )
    elif late > MOST_DELAY:
        cause = f"the dead time is {late} samples. Models with this delay follow."
    elif integrating(records):
        cause = (
            "an output drifts with the sum of the inputs, so that small input errors accumulate. "
            f"Models with free integrators follow. {advice}"
        )
    else:
        cause = (
            "the inputs have an effect, but no model so far predicts it over a whole simulation. "
            f"Other initial values and model classes follow. {advice}"
        )
    return f"no candidate beats the mean of the output{best}: {cause}"
