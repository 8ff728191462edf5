"""Two tanks in series with overflow, simulated: water from a pump runs through an upper tank,
which is not measured, into a lower one."""

from math import sqrt

import numpy as np

from asia.data.sources.simulated import Simulation
from asia.data.sources.source import Subset
from asia.data.trajectory import Array

SAMPLING_TIME = 4.0
SAMPLES = 1024
NOISE_STD = 0.05

_K1, _K2, _K3, _K4 = 0.055, 0.050, 0.050, 0.048
_FULL = 10.0
_SPILL_SHARE = 0.3
_SUBSTEPS = 8
_DECIMALS = 4


def two_tanks_records(seed: int, subset: Subset, guard: int) -> dict[str, Simulation]:
    """One training and one test record, and guard records."""
    if subset == "guard":
        return {f"two_tanks_guard{k + 1}": simulate_two_tanks(seed, 2 + k) for k in range(guard)}
    number = ("train", "test").index(subset)
    return {f"two_tanks_{subset}": simulate_two_tanks(seed, number)}


def simulate_two_tanks(seed: int, realisation: int) -> Simulation:
    """One record of 1024 samples at 4 s; another `realisation` has another input, initial state
    and noise. Outputs are rounded to 0.1 mV, far below the noise of 50 mV, so that a digest of
    the record does not depend on the last bit of the machine's arithmetic."""
    random = np.random.default_rng([seed, realisation])
    u = _multisine(random)
    start = random.uniform(2.0, 7.0, size=2)
    truth = _levels(u, float(start[0]), float(start[1]))
    y = np.round(truth + NOISE_STD * random.standard_normal(SAMPLES), _DECIMALS)
    return Simulation(u[:, None], y[:, None], truth[:, None])


def _multisine(random: np.random.Generator) -> Array:
    """Random-phase multisine up to 14 mHz, most of its power below 5 mHz, within the pump's
    0 to 7 V."""
    lines = np.arange(1, 60)
    amplitudes = np.where(lines < 20, 0.33, 0.033)
    phases = random.uniform(0.0, 2.0 * np.pi, size=lines.size)
    time = np.arange(SAMPLES) / SAMPLES
    waves = np.cos(2.0 * np.pi * lines * time[:, None] + phases)
    return np.round(np.clip(2.8 + waves @ amplitudes, 0.0, 7.0), _DECIMALS)


def _slopes(upper: float, lower: float, pump: float) -> tuple[float, float]:
    drop = sqrt(max(upper, 0.0))
    return -_K1 * drop + _K4 * pump, _K2 * drop - _K3 * sqrt(max(lower, 0.0))


def _levels(u: Array, upper: float, lower: float) -> Array:
    """Simulate the level of the lower tank at each sample with zero-order-hold inputs.

    Part of the overflow of the upper tank falls into the lower one; the rest is lost, as is the
    overflow of the lower tank.
    """
    levels = np.empty(len(u))
    h = SAMPLING_TIME / _SUBSTEPS
    for sample, pump in enumerate(u.tolist()):
        levels[sample] = lower
        for _ in range(_SUBSTEPS):
            a1, b1 = _slopes(upper, lower, pump)
            a2, b2 = _slopes(upper + h / 2 * a1, lower + h / 2 * b1, pump)
            a3, b3 = _slopes(upper + h / 2 * a2, lower + h / 2 * b2, pump)
            a4, b4 = _slopes(upper + h * a3, lower + h * b3, pump)
            upper = max(upper + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), 0.0)
            lower = max(lower + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4), 0.0)
            spill = max(upper - _FULL, 0.0)
            upper -= spill
            lower = min(lower + _SPILL_SHARE * spill, _FULL)
    return levels
