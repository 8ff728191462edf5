"""Effect, delay, feedback and stability against systems where they are known."""

import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.data.statistics import acts, feedback_size, unstable
from asia.problem.obstacles import least_delay, obstacle

SAMPLES = 1000


def records(u: Array, y: Array) -> list[Trajectory]:
    return [Trajectory(u, y, 1.0)]


def lagged(u: Array, delay: int, pole: float = 0.8) -> Array:
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + (u[k - delay] if k >= delay else 0.0)
    return y


def closed_loop(pole: float, gain: float, seed: int = 0) -> list[Trajectory]:
    """x[k+1] = pole x + u + a disturbance that is not seen; u = -gain y + a small excitation."""
    rng = np.random.default_rng(seed)
    x, us, ys = 0.0, np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        ys[k] = x + 0.02 * rng.standard_normal()
        us[k] = -gain * ys[k] + 0.2 * rng.standard_normal()
        x = pole * x + us[k] + 0.5 * rng.standard_normal()
    return records(us, ys)


@pytest.mark.parametrize("delay", [1, 4, 25])
def test_the_delay_after_which_the_input_acts_is_found(delay: int) -> None:
    rng = np.random.default_rng(delay)
    u = np.repeat(rng.uniform(-1, 1, SAMPLES // 5), 5)
    found = records(u, lagged(u, delay) + 0.05 * rng.standard_normal(SAMPLES))
    assert acts(found)
    assert least_delay(found) == delay
    assert feedback_size(found) == 0.0
    assert not unstable(found)
    text = obstacle(found, None, 0, " (best V 1.02 of #03)")
    assert "the mean of the output (best V 1.02 of #03): " in text
    assert (f"the dead time is {delay} samples" in text) == (delay > 10)


@pytest.mark.parametrize("seed", range(2))
def test_noise_next_to_an_input_is_no_effect_and_no_feedback(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = records(rng.standard_normal(SAMPLES), lagged(rng.standard_normal(SAMPLES), 1))
    assert not acts(found)
    assert feedback_size(found) == 0.0
    assert "no input and no squared input has a significant effect" in obstacle(found, 20, 5, "")


def test_an_even_effect_is_an_effect() -> None:
    u = np.random.default_rng(3).standard_normal(SAMPLES)
    assert acts(records(u, lagged(u**2, 1)))


@pytest.mark.parametrize(("pole", "grows"), [(1.05, True), (0.9, False)])
def test_a_loop_is_seen_and_whether_it_holds_an_unstable_plant(pole: float, grows: bool) -> None:
    found = closed_loop(pole, 0.5)
    assert feedback_size(found) > 0.1
    assert unstable(found) == grows


def test_an_input_without_news_acts_all_the_same() -> None:
    time = np.arange(SAMPLES) / SAMPLES
    rng = np.random.default_rng(2)
    phases = rng.uniform(0, 2 * np.pi, 20)
    u = sum(np.cos(2 * np.pi * (k + 1) * time + phase) for k, phase in enumerate(phases))
    found = records(np.asarray(u), lagged(np.asarray(u), 1) + rng.standard_normal(SAMPLES))
    assert acts(found)
    assert feedback_size(found) == 0.0
