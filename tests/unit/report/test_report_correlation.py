from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asia.data import Signal
from asia.judge.scoring.residuals import cross_correlation, independent_band, white_band
from asia.report.pictures.evidence import draw_correlations


def coloured(rng: np.random.Generator, samples: int) -> np.ndarray:
    y = np.zeros(samples)
    for t in range(1, samples):
        y[t] = 0.95 * y[t - 1] + rng.standard_normal()
    return y


def test_a_delayed_copy_peaks_at_its_lag() -> None:
    u = np.random.default_rng(0).standard_normal(500)
    e = np.roll(u, 3)
    values = cross_correlation([e[5:250], e[255:]], [u[5:250], u[255:]], 10)
    assert np.argmax(values) - 10 == 3
    assert values.max() > 0.95


def test_white_residuals_stay_in_the_band() -> None:
    e = np.random.default_rng(1).standard_normal(4000)
    values = cross_correlation([e], [e], 100)[101:]
    assert values.shape == (100,)
    assert np.mean(np.abs(values) > white_band(4000)) <= 0.04


def test_the_band_of_independent_coloured_signals_holds_where_the_white_one_fails() -> None:
    inside_white, inside = [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        e, u = coloured(rng, 600), coloured(rng, 600)
        value = abs(cross_correlation([e], [u], 0)[0])
        inside_white.append(value < white_band(600))
        inside.append(value < independent_band([e], [u], 150))
    assert np.mean(inside_white) < 0.7
    assert np.mean(inside) >= 0.93


def test_products_never_join_two_blocks() -> None:
    a = [np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])]
    joined = cross_correlation([np.concatenate(a)], [np.concatenate(a)], 1)[2]
    assert cross_correlation(a, a, 1)[2] < 0.0 < joined


def test_an_input_that_never_moves_is_drawn_without_a_warning() -> None:
    e = np.random.default_rng(2).standard_normal(200)
    row = Figure().subplots(1, 2).tolist()
    draw_correlations(row, [e], [[np.ones(200)]], [Signal("u")], last=True)
    low, high = row[1].get_ylim()
    assert low < 0.0 < high
