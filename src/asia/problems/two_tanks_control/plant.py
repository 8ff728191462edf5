"""Two tanks in series with overflow, as the simulator of `two_tanks_sim`: the pump fills the upper
tank, which runs into the lower one. Levels and the pump voltage in V, times in s."""

from collections.abc import Mapping, Sequence
from math import sqrt

FULL = 10.0
SPILL_SHARE = 0.3
SUBSTEPS = 8


def slopes(
    upper: float, lower: float, pump: float, leak: float, p: Mapping[str, float]
) -> tuple[float, float]:
    drop = sqrt(max(upper, 0.0))
    return (
        -p["k1"] * drop + p["k4"] * pump,
        p["k2"] * drop - p["k3"] * sqrt(max(lower, 0.0)) - leak,
    )


def step(
    x: tuple[float, float] | None, u: Sequence[float], params: Mapping[str, float], dt: float
) -> tuple[tuple[float, float], list[float]]:
    """Levels (upper, lower) at the end of a sample, from rest at 2.8 V."""
    pump, leak = float(u[0]), float(u[1])
    if x is None:
        upper = (params["k4"] * 2.8 / params["k1"]) ** 2
        lower = (params["k2"] / params["k3"]) ** 2 * upper
        return (upper, lower), [lower]
    upper, lower = x
    h = dt / SUBSTEPS
    for _ in range(SUBSTEPS):
        a1, b1 = slopes(upper, lower, pump, leak, params)
        a2, b2 = slopes(upper + h / 2 * a1, lower + h / 2 * b1, pump, leak, params)
        a3, b3 = slopes(upper + h / 2 * a2, lower + h / 2 * b2, pump, leak, params)
        a4, b4 = slopes(upper + h * a3, lower + h * b3, pump, leak, params)
        upper = max(upper + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), 0.0)
        lower = max(lower + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4), 0.0)
        spill = max(upper - FULL, 0.0)
        upper -= spill
        lower = min(lower + SPILL_SHARE * spill, FULL)
    return (upper, lower), [lower]
