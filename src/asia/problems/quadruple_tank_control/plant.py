"""Quadruple tank at its minimum-phase point: K. H. Johansson, IEEE Trans. Control Systems
Technology 8(3), 2000. Levels of the four tanks in cm, pump voltages in V, times in s."""

from collections.abc import Mapping, Sequence
from math import sqrt

AREA = (28.0, 32.0, 28.0, 32.0)  # cm^2
OUTLET = (0.071, 0.057, 0.071, 0.057)  # cm^2
GRAVITY = 981.0  # cm/s^2
SUBSTEPS = 4


def slopes(
    h: Sequence[float], v1: float, v2: float, leak: float, p: Mapping[str, float]
) -> tuple[float, ...]:
    q = [a * sqrt(2.0 * GRAVITY * max(level, 0.0)) for a, level in zip(OUTLET, h, strict=True)]
    g1, g2, k1, k2 = p["gamma1"], p["gamma2"], p["k1"], p["k2"]
    return (
        (-q[0] + q[2] + g1 * k1 * v1 - leak) / AREA[0],
        (-q[1] + q[3] + g2 * k2 * v2) / AREA[1],
        (-q[2] + (1.0 - g2) * k2 * v2) / AREA[2],
        (-q[3] + (1.0 - g1) * k1 * v1) / AREA[3],
    )


def rest(v1: float, v2: float, p: Mapping[str, float]) -> tuple[float, ...]:
    g1, g2, k1, k2 = p["gamma1"], p["gamma2"], p["k1"], p["k2"]
    q3, q4 = (1.0 - g2) * k2 * v2, (1.0 - g1) * k1 * v1
    flows = (q3 + g1 * k1 * v1, q4 + g2 * k2 * v2, q3, q4)
    return tuple((q / a) ** 2 / (2.0 * GRAVITY) for q, a in zip(flows, OUTLET, strict=True))


def step(
    x: Sequence[float] | None, u: Sequence[float], params: Mapping[str, float], dt: float
) -> tuple[Sequence[float], list[float]]:
    """Levels at the end of a sample, from rest at 3 V; the lower two are measured."""
    if x is None:
        x = rest(3.0, 3.0, params)
        return x, [x[0], x[1]]
    v1, v2, leak = (float(one) for one in u)
    h = dt / SUBSTEPS
    for _ in range(SUBSTEPS):
        a = slopes(x, v1, v2, leak, params)
        b = slopes([s + h / 2 * d for s, d in zip(x, a, strict=True)], v1, v2, leak, params)
        c = slopes([s + h / 2 * d for s, d in zip(x, b, strict=True)], v1, v2, leak, params)
        e = slopes([s + h * d for s, d in zip(x, c, strict=True)], v1, v2, leak, params)
        x = tuple(
            min(max(s + h / 6 * (i + 2 * j + 2 * k + m), 0.0), 20.0)
            for s, i, j, k, m in zip(x, a, b, c, e, strict=True)
        )
    return x, [x[0], x[1]]
