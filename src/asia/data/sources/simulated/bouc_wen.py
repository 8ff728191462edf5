"""A mass on a spring and a damper with hysteresis of Bouc and Wen, simulated from its published
equations: J. P. Noël and M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", Workshop
on Nonlinear System Identification Benchmarks, 2016."""

from math import pi

import numpy as np

from asia.data.sources.simulated import Simulation
from asia.data.sources.source import Subset
from asia.data.trajectory import Array

SAMPLING_TIME = 1.0 / 750.0
NOISE_STD = 8e-6
"""Standard deviation of the noise of the training records, m."""

_MASS, _DAMPING, _STIFFNESS = 2.0, 10.0, 5e4
_ALPHA, _BETA, _GAMMA, _DELTA = 5e4, 1e3, 0.8, -1.1

_PERIOD = 8_192
_BAND_HZ = (5.0, 150.0)
_RMS_N = 50.0
_TRAIN_RECORDS = 4
_SETTLE = 512
_SUBSTEPS = 8
_SWEEP_HZ = (20.0, 50.0)
_SWEEP_SECONDS = 30.0
_SWEEP_N = 40.0
_DECIMALS = 9
_INPUT_DECIMALS = 6


def bouc_wen_records(seed: int, subset: Subset, guard: int) -> dict[str, Simulation]:
    """Training and guard records: multisines with noise. Test: a multisine of other phases and a
    slow sine sweep, without noise."""
    if subset == "test":
        return {"multisine_test": _multisine(seed, 0, noise=0.0), "sweep_test": _sweep()}
    if subset == "guard":
        first = 1 + _TRAIN_RECORDS
        return {
            f"bouc_wen_guard{k + 1}": _multisine(seed, first + k, NOISE_STD) for k in range(guard)
        }
    return {f"multisine{k}": _multisine(seed, k, NOISE_STD) for k in range(1, 1 + _TRAIN_RECORDS)}


def _multisine(seed: int, number: int, noise: float) -> Simulation:
    """One period of a random-phase multisine of 50 N RMS from 5 to 150 Hz, after a while of the
    period before it. Outputs are rounded to 1e-9 m, far below the
    noise, so that a digest does not depend on the last bit of the machine's arithmetic."""
    random = np.random.default_rng([seed, number])
    lines = np.arange(*(int(f * _PERIOD * SAMPLING_TIME) for f in _BAND_HZ))
    half_steps = 2 * _SUBSTEPS
    spectrum = np.zeros(_PERIOD * half_steps // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * pi * random.uniform(size=lines.size))
    fine = np.fft.irfft(spectrum)
    fine = np.round(fine * _RMS_N / np.sqrt(np.mean(fine**2)), _INPUT_DECIMALS)
    settled = np.concatenate([fine[-_SETTLE * half_steps :], fine, fine[:1]])
    truth = np.round(_displacement(settled)[_SETTLE:], _DECIMALS)
    y = np.round(truth + noise * random.standard_normal(_PERIOD), _DECIMALS)
    return Simulation(fine[::half_steps, None], y[:, None], truth[:, None])


def _sweep() -> Simulation:
    """A sine of 40 N from 20 to 50 Hz; the published one takes six times as long."""
    half_steps = 2 * _SUBSTEPS
    samples = round(_SWEEP_SECONDS / SAMPLING_TIME)
    time = np.arange(samples * half_steps + 1) * (SAMPLING_TIME / half_steps)
    low, high = _SWEEP_HZ
    turns = (low + (high - low) * time / (2 * _SWEEP_SECONDS)) * time
    fine = np.round(_SWEEP_N * np.sin(2 * pi * turns), _INPUT_DECIMALS)
    truth = np.round(_displacement(fine), _DECIMALS)[:, None]
    return Simulation(fine[:-1:half_steps, None], truth, truth)


def _displacement(force: Array) -> Array:
    """The displacement, m, at each sample.

    Args:
        force: at every half substep and at the end; from rest, by Runge and Kutta's method of
            order four
    """
    h = SAMPLING_TIME / _SUBSTEPS
    forces = force.tolist()
    found = np.empty((len(forces) - 1) // (2 * _SUBSTEPS))
    y = v = z = 0.0
    for step in range(len(found) * _SUBSTEPS):
        if step % _SUBSTEPS == 0:
            found[step // _SUBSTEPS] = y
        before, middle, after = forces[2 * step : 2 * step + 3]
        v1, a1, z1 = _slopes(y, v, z, before)
        v2, a2, z2 = _slopes(y + h / 2 * v1, v + h / 2 * a1, z + h / 2 * z1, middle)
        v3, a3, z3 = _slopes(y + h / 2 * v2, v + h / 2 * a2, z + h / 2 * z2, middle)
        v4, a4, z4 = _slopes(y + h * v3, v + h * a3, z + h * z3, after)
        y += h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        z += h / 6 * (z1 + 2 * z2 + 2 * z3 + z4)
    return found


def _slopes(y: float, v: float, z: float, force: float) -> tuple[float, float, float]:
    """Time derivatives of displacement, velocity and hysteretic force, at exponent 1."""
    acceleration = (force - _DAMPING * v - _STIFFNESS * y - z) / _MASS
    return v, acceleration, _ALPHA * v - _BETA * (_GAMMA * abs(v) * z + _DELTA * v * abs(z))
