"""Stirred tank reactor with the reactions A -> B -> C and 2 A -> D (van de Vusse): K.-U. Klatt and
S. Engell, Computers & Chemical Engineering 22(4/5), 1998. Concentrations in mol/l, temperatures in
degrees Celsius, times in h inside, in s outside."""

from collections.abc import Mapping, Sequence
from math import exp

K1, K2, K3 = 1.287e12, 1.287e12, 9.043e9  # 1/h, 1/h, l/(mol h)
E1, E2, E3 = -9758.3, -9758.3, -8560.0  # K
H_AB, H_BC, H_AD = 4.2, -11.0, -41.85  # kJ/mol
DENSITY, HEAT = 0.9342, 3.01  # kg/l, kJ/(kg K)
EXCHANGE, AREA, VOLUME = 4032.0, 0.215, 10.0  # kJ/(h m^2 K), m^2, l
COOLANT, COOLANT_HEAT = 5.0, 2.0  # kg, kJ/(kg K)
FLOW, POWER = 14.19, -1113.5  # 1/h, kJ/h
SUBSTEPS = 4


def slopes(
    x: Sequence[float], flow: float, power: float, inlet: float, p: Mapping[str, float]
) -> tuple[float, ...]:
    ca, cb, t, tk = x
    # The exponents stay finite where a loop diverges.
    kelvin = min(max(t, -100.0), 400.0) + 273.15
    k1, k2, k3 = (k * exp(e / kelvin) for k, e in ((K1 * p["activity"], E1), (K2, E2), (K3, E3)))
    heat = k1 * ca * H_AB + k2 * cb * H_BC + k3 * ca * ca * H_AD
    wall = EXCHANGE * p["fouling"] * AREA
    return (
        flow * (p["feed"] - ca) - k1 * ca - k3 * ca * ca,
        -flow * cb + k1 * ca - k2 * cb,
        flow * (inlet - t) - heat / (DENSITY * HEAT) + wall * (tk - t) / (DENSITY * HEAT * VOLUME),
        (power + wall * (t - tk)) / (COOLANT * COOLANT_HEAT),
    )


def moved(
    x: Sequence[float], flow: float, power: float, inlet: float, p: Mapping[str, float], h: float
) -> tuple[float, ...]:
    a = slopes(x, flow, power, inlet, p)
    b = slopes([s + h / 2 * d for s, d in zip(x, a, strict=True)], flow, power, inlet, p)
    c = slopes([s + h / 2 * d for s, d in zip(x, b, strict=True)], flow, power, inlet, p)
    e = slopes([s + h * d for s, d in zip(x, c, strict=True)], flow, power, inlet, p)
    return tuple(
        s + h / 6 * (i + 2 * j + 2 * k + m) for s, i, j, k, m in zip(x, a, b, c, e, strict=True)
    )


def step(
    x: Sequence[float] | None, u: Sequence[float], params: Mapping[str, float], dt: float
) -> tuple[Sequence[float], list[float]]:
    """Concentration of B and temperature at the end of a sample, from rest."""
    if x is None:
        x = (2.14, 1.09, 114.2, 112.9)
        for _ in range(2000):
            x = moved(x, FLOW, POWER, 104.9, params, 0.001)
        return x, [x[1], x[2]]
    flow, power, warmer = (float(one) for one in u)
    h = dt / 3600.0 / SUBSTEPS
    for _ in range(SUBSTEPS):
        x = moved(x, flow, power, 104.9 + warmer, params, h)
    return x, [x[1], x[2]]
