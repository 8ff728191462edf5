"""Estimates of the noise model on drawn residuals."""

from __future__ import annotations

import numpy as np
import pytest

from asia.data import Array
from asia.errors import UserError
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import NoiseChoice, ResidualNoise, estimate_noise, settled
from tests.unit.models.noise.drawn import slow_disturbance

DT = 2.0
FLOOR = np.full(1, 1e-9)


def drawn(samples: int, time: float, slow: float, white: float, seed: int = 0) -> Array:
    """A slow disturbance and white noise (1, T, 1)."""
    rng = np.random.default_rng(seed)
    x = slow * slow_disturbance(samples, float(np.exp(-DT / time)), rng)
    return (x + white * rng.standard_normal(samples))[None, :, None]


def estimated(residual: Array, choice: NoiseChoice, mask: Array | None = None) -> ResidualNoise:
    mask = np.ones(residual.shape) if mask is None else mask
    return estimate_noise(residual, mask, DT, choice, FLOOR)


@pytest.mark.parametrize("time", [10.0, 60.0, 200.0])
def test_known_numbers_are_recovered(time: float) -> None:
    residual = drawn(8000, time, 0.5, 0.2)
    found = estimated(residual, NoiseChoice(slow=True))
    assert np.log(found.time[0] / time) == pytest.approx(0.0, abs=0.35)
    assert np.log(found.slow[0] / 0.5) == pytest.approx(0.0, abs=0.2)
    assert np.log(found.white[0] / 0.2) == pytest.approx(0.0, abs=0.05)


def test_white_noise_has_no_slow_part() -> None:
    residual = drawn(1000, 60.0, 0.0, 0.3)
    found = estimated(residual, NoiseChoice(slow=True))
    assert found.slow[0] == 0.0
    assert found.white[0] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-6)
    coloured = estimated(drawn(1000, 60.0, 0.5, 0.2), NoiseChoice(slow=False, huber=3.0))
    assert coloured.slow[0] == 0.0


def test_padding_and_gaps_do_not_count() -> None:
    residual = drawn(3000, 60.0, 0.5, 0.2)
    mask = np.ones(residual.shape)
    mask[:, 2500:], mask[:, 400:450] = 0.0, 0.0
    found = estimated(np.where(mask > 0, residual, 1e3), NoiseChoice(slow=True), mask)
    assert found.slow[0] == pytest.approx(0.5, rel=0.25)
    assert found.white[0] == pytest.approx(0.2, rel=0.1)


def test_outliers_count_less_with_a_threshold() -> None:
    residual = drawn(2000, 60.0, 0.0, 0.2)
    residual[0, ::40] += 3.0
    robust = estimated(residual, NoiseChoice(slow=False, huber=2.0)).white[0]
    plain = estimated(residual, NoiseChoice(slow=False)).white[0]
    assert robust < 0.6 * plain


def test_estimates_settle() -> None:
    noise = ResidualNoise(np.array([50.0]), np.array([0.5]), np.array([0.2]))
    assert not settled(None, noise)
    assert settled(noise._replace(time=noise.time * 1.05), noise)
    assert not settled(noise._replace(time=noise.time * 1.5), noise)
    assert not settled(noise._replace(slow=noise.slow * 1.2), noise)
    none = noise._replace(slow=np.zeros(1))
    assert settled(none._replace(time=none.time * 2.0), none)


@pytest.mark.parametrize(
    "wrong",
    [
        {"noise_model": "brown"},
        {"huber": -1.0},
    ],
)
def test_settings_that_cannot_be(wrong: dict[str, object]) -> None:
    with pytest.raises(UserError, match="LevenbergMarquardt"):
        LevenbergMarquardt(**wrong)  # pyright: ignore[reportArgumentType]
