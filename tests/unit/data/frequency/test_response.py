"""Noise, distortion and the best linear approximation against simulated systems."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from asia.data import Array, Trajectory
from asia.data.frequency import FrequencyResponse, find_period, frequency_response

N = 1024
BEFORE, AFTER = signal.butter(2, 0.3), signal.butter(1, 0.4)
CUBE, SQUARE = 0.1, 0.05


def multisine(seed: int, kind: str) -> Array:
    """One period of unit standard deviation; "random odd" leaves out one line in four of the odd
    ones, "odd" none of these, "full" no line."""
    rng = np.random.default_rng(seed)
    lines = np.arange(1, N // 4) if kind == "full" else np.arange(1, N // 4, 2)
    if kind == "random odd":
        groups = lines[: len(lines) // 4 * 4].reshape(-1, 4)
        out = groups[np.arange(len(groups)), np.random.default_rng(1).integers(0, 4, len(groups))]
        lines = np.setdiff1d(lines, out)
    time = np.arange(N)[:, None] / N
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    return np.cos(2 * np.pi * lines * time + phases).sum(axis=1) / np.sqrt(lines.size / 2)


def filtered(block: tuple[Array, Array], values: Array) -> Array:
    return np.asarray(signal.lfilter(*block, values))


def bent(x: Array) -> tuple[Array, Array, Array]:
    """Linear part of a cubic for Gaussian x, and distortions of odd and of even degree."""
    linear = (1.0 + 3.0 * CUBE * x.var()) * x
    return linear, x + CUBE * x**3 - linear, SQUARE * (x**2 - x.var())


def made(seed: int, kind: str, periods: int, noise: float, settle: int = 2):
    """A record and the standard deviations of its odd and even distortion and output."""
    u = np.tile(multisine(seed, kind), periods + settle)
    parts = [filtered(AFTER, part) for part in bent(filtered(BEFORE, u))]
    odd, even = (part[-N:].std() for part in parts[1:])
    y = sum(parts)
    std = y[-N:].std()
    y = y + noise * std * np.random.default_rng(seed + 1000).normal(size=len(y))
    cut = slice(settle * N, None)
    return Trajectory(u[cut], y[cut], 0.01, f"r{seed}"), np.array([odd, even]) / std


def of(kind: str, realisations: int, periods: int = 4, noise: float = 0.002):
    made_ones = [made(100 + s, kind, periods, noise) for s in range(realisations)]
    truth = np.sqrt(np.mean([levels**2 for _, levels in made_ones], axis=0))
    found = frequency_response([r for r, _ in made_ones], 0, N)
    assert found is not None
    return found, truth


def decibels(value: float | None) -> float:
    assert value is not None
    return 20.0 * np.log10(value)


def true_gain(found: FrequencyResponse, variance: float) -> Array:
    z = np.exp(2j * np.pi * found.frequency * 0.01)
    before, after = (np.polyval(b, z) / np.polyval(a, z) for b, a in (BEFORE, AFTER))
    return (1.0 + 3.0 * CUBE * variance) * before * after


@pytest.mark.parametrize(("kind", "count"), [("random odd", 6), ("random odd", 1), ("odd", 8)])
def test_noise_and_odd_and_even_distortion_are_within_a_decibel(kind: str, count: int) -> None:
    found, truth = of(kind, count)
    levels = found.levels
    assert decibels(levels.noise) == pytest.approx(20 * np.log10(0.002), abs=1.0)
    assert decibels(levels.odd) == pytest.approx(20 * np.log10(truth[0]), abs=1.0)
    assert decibels(levels.even) == pytest.approx(20 * np.log10(truth[1]), abs=1.0)
    total = np.sqrt((truth**2).sum() + 0.002**2)
    assert decibels(levels.both) == pytest.approx(20 * np.log10(total), abs=1.0)


def test_a_full_multisine_tells_distortion_from_noise_and_not_its_degree() -> None:
    found, truth = of("full", 8)
    assert found.levels.odd is None
    assert found.levels.even is None
    whole = 20 * np.log10(np.sqrt((truth**2).sum()))
    assert decibels(found.levels.distortion) == pytest.approx(whole, abs=1.0)


def test_one_realisation_of_a_full_multisine_gives_only_the_noise() -> None:
    found, _ = of("full", 1, noise=0.02)
    assert found.levels.distortion is None
    assert decibels(found.levels.noise) == pytest.approx(20 * np.log10(0.02), abs=1.0)


def test_the_best_linear_approximation_is_that_of_a_gaussian_input() -> None:
    found, _ = of("odd", 16)
    x = filtered(BEFORE, np.tile(multisine(100, "odd"), 3))[-N:]
    excited = np.isfinite(found.gain[:, 0])
    ratio = abs(found.gain[excited, 0] / true_gain(found, x.var())[excited])
    assert np.median(abs(20 * np.log10(ratio))) < 1.0


def test_a_transient_is_left_out_and_noise_is_not_taken_for_one() -> None:
    still, _ = made(100, "odd", 4, 0.01)
    slow, _ = made(100, "odd", 4, 0.01)
    y = slow.y.copy()
    y[:, 0] += 3.0 * y.std() * np.exp(-np.arange(len(y)) / 100.0)
    for record, used in ((still, 4), (Trajectory(slow.u, y, 0.01, "late"), 3)):
        found = frequency_response([record], 0, N)
        assert found is not None
        assert found.periods == used
        assert decibels(found.levels.noise) == pytest.approx(-40.0, abs=1.0)


def test_without_periods_the_linear_residual_is_separated_from_leakage() -> None:
    rng = np.random.default_rng(100)
    u = filtered(signal.butter(2, 0.5), rng.normal(size=20_000))
    y = filtered(BEFORE, u)
    for noise in (0.3, 0.03):
        record = Trajectory(u, y + noise * y.std() * rng.normal(size=len(y)), 0.01)
        found = frequency_response([record], 0, None)
        assert found is not None
        # Relative to the measured output, noise included.
        truth = noise / np.sqrt(1.0 + noise**2)
        assert decibels(found.levels.both) == pytest.approx(20 * np.log10(truth), abs=1.0)
        band = found.frequency < 10.0
        z = np.exp(2j * np.pi * found.frequency[band] * 0.01)
        ratio = found.gain[band, 0] * np.polyval(BEFORE[1], z) / np.polyval(BEFORE[0], z)
        assert np.median(abs(ratio - 1.0)) < noise


def test_a_start_that_is_not_at_rest_is_not_taken_for_noise() -> None:
    rng = np.random.default_rng(100)
    u = np.repeat(rng.uniform(-1, 1, 60), 10)
    slow = (np.array([0.0, 0.2]), np.array([1.0, -0.8]))
    y = filtered(slow, u) + 1.0
    record = Trajectory(u, y + 0.01 * y.std() * rng.normal(size=len(y)), 1.0)
    found = frequency_response([record, record], 0, None)
    assert found is not None
    assert decibels(found.levels.both) == pytest.approx(-40.0, abs=6.0)


def test_several_inputs_are_separated() -> None:
    rng = np.random.default_rng(100)
    u = rng.normal(size=(4000, 2))
    y = filtered(BEFORE, u[:, 0]) - 0.5 * filtered(AFTER, u[:, 1])
    record = Trajectory(u, y + 0.1 * y.std() * rng.normal(size=len(y)), 0.01)
    found = frequency_response([record], 0, None)
    assert found is not None
    assert decibels(found.levels.both) == pytest.approx(-20.0, abs=1.0)


def test_periods_are_found_where_there_are_some() -> None:
    full, odd = made(100, "full", 3, 0.01)[0], made(101, "odd", 4, 0.01)[0]
    assert find_period([full]) == N
    assert find_period([full, odd]) == N
    noisy = Trajectory(
        full.u + 0.03 * np.random.default_rng(0).normal(size=full.u.shape), full.y, 1
    )
    assert find_period([noisy]) == N
    assert find_period([full[: 2 * N - 5]]) is None
    assert (
        find_period([Trajectory(np.random.default_rng(0).normal(size=500), full.y[:500], 1)])
        is None
    )
    steps = np.repeat(np.random.default_rng(0).uniform(-1, 1, 60), 10)
    assert find_period([Trajectory(steps, steps, 1.0)]) is None
    assert find_period([Trajectory(np.ones(100), np.ones(100), 1.0)]) is None


def test_too_little_says_nothing() -> None:
    short = Trajectory(np.arange(20.0), np.arange(20.0), 1.0)
    assert frequency_response([short], 0, None) is None
    still = Trajectory(np.arange(500.0), np.ones(500), 1.0)
    assert frequency_response([still], 0, None) is None
