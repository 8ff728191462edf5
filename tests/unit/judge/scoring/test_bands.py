import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.judge.scoring.bands import (
    HeldOutErrors,
    calibrate,
    error_sizes,
    independent_errors,
    output_bands,
    raised_level,
    region_of,
)


def coloured(rng: np.random.Generator, samples: int, pole: float) -> np.ndarray:
    white = rng.normal(size=samples)
    e = np.zeros(samples)
    for t in range(1, samples):
        e[t] = pole * e[t - 1] + white[t]
    return e[:, None]


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_bands_hold_their_share_of_new_samples(pole: float) -> None:
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(40):
        folds = [HeldOutErrors((coloured(rng, 400, pole),)) for _ in range(3)]
        y_hat = rng.normal(size=(1, 300, 1)).repeat(3, axis=0)
        bands = output_bands(folds, y_hat, 0.9)
        y = y_hat[0] + coloured(rng, 300, pole)
        shares.append(np.mean((bands.lower <= y) & (y <= bands.upper)))
    assert 0.88 < np.mean(shares) < 0.93


def test_bands_of_equal_simulations_are_quantiles_of_the_errors() -> None:
    errors = np.arange(1.0, 101.0)[:, None] * np.where(np.arange(100) % 2, 1.0, -1.0)[:, None]
    bands = output_bands([HeldOutErrors((errors,))], np.zeros((1, 2, 1)), 0.5)
    reach = raised_level(0.5, independent_errors([[errors[:, 0]]]))
    assert bands.upper[:, 0] == pytest.approx(np.ceil(100 * reach))
    assert bands.lower == pytest.approx(-bands.upper)


def test_fold_models_that_disagree_make_the_bands_wider() -> None:
    rng = np.random.default_rng(1)
    folds = [HeldOutErrors((rng.normal(size=(200, 1)),)) for _ in range(2)]
    apart = np.stack([np.full((5, 1), -3.0), np.full((5, 1), 3.0)])
    alike, other = (output_bands(folds, y_hat, 0.9) for y_hat in (0.0 * apart, apart))
    assert np.all(other.upper - other.lower > alike.upper - alike.lower)


def test_the_edge_is_the_same_in_order_and_by_halving(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    sizes = error_sizes([HeldOutErrors((rng.normal(size=(150, 2)),)) for _ in range(3)])
    y_hat = rng.normal(size=(3, 20, 2))
    in_order = output_bands(sizes, y_hat, 0.9, np.linspace(1.0, 3.0, 20))
    monkeypatch.setattr("asia.judge.scoring.bands._FEW", 0)
    halved = output_bands(sizes, y_hat, 0.9, np.linspace(1.0, 3.0, 20))
    np.testing.assert_allclose(in_order.upper, halved.upper, atol=1e-9)
    np.testing.assert_allclose(in_order.lower, halved.lower, atol=1e-9)


def test_errors_of_windows_are_those_of_the_step() -> None:
    rng = np.random.default_rng(2)
    growing = tuple(rng.normal(size=(50, 1)) * np.arange(1, 51)[:, None] for _ in range(100))
    bands = output_bands([HeldOutErrors(growing)], np.zeros((1, 70, 1)), 0.9, by_step=True)
    width = bands.upper[:, 0]
    assert width[0] < 0.1 * width[49]
    assert width[50:] == pytest.approx(width[49])
    assert width[24] / 25 == pytest.approx(1.645, rel=0.2)


def test_few_independent_errors_raise_the_level() -> None:
    slow = coloured(np.random.default_rng(3), 1000, 0.99)[:, 0]
    assert independent_errors([[slow]]) < 40
    assert raised_level(0.9, 40) == pytest.approx(0.9225)
    assert raised_level(0.9, 3) == 1.0


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1])
def test_a_level_is_a_share(level: float) -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        output_bands([HeldOutErrors((np.ones((3, 1)),))], np.zeros((1, 1, 1)), level)


@given(seed=st.integers(0, 1000), low=st.floats(0.1, 0.8), more=st.floats(0.01, 0.19))
@settings(max_examples=30, deadline=None)
def test_a_higher_level_has_wider_bands_and_factors_widen(
    seed: int, low: float, more: float
) -> None:
    rng = np.random.default_rng(seed)
    folds = [HeldOutErrors((rng.normal(size=(60, 2)),)) for _ in range(3)]
    y_hat = rng.normal(size=(3, 7, 2))
    narrow, wide = (output_bands(folds, y_hat, level) for level in (low, low + more))
    wider = output_bands(folds, y_hat, low, np.full(7, 2.0))
    for other in (wide, wider):
        assert np.all(other.upper >= narrow.upper - 1e-9)
        assert np.all(other.lower <= narrow.lower + 1e-9)


def test_the_region_of_validity_knows_its_cloud() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=(2000, 1))
    y = np.cumsum(u, axis=0) * 0.01
    region = region_of([(u, y)])
    inside = region.distance(u[:0], u, y)
    assert np.mean(inside > 1.0) == pytest.approx(0.01, abs=0.002)
    assert np.all(region.distance(u[:64], u[64:200], y[64:200] + 10.0) > 1.0)
    steady = region.distance(np.full((64, 1), 3.0), np.full((50, 1), 3.0), np.zeros((50, 1)))
    assert np.all(steady > 1.0)


def test_a_constant_input_has_a_region() -> None:
    region = region_of([(np.ones((50, 1)), np.arange(50.0)[:, None])])
    assert np.isfinite(region.distance(np.ones((2, 1)), np.ones((3, 1)), np.ones((3, 1)))).all()
    assert region.distance(np.ones((0, 1)), 2 * np.ones((3, 1)), np.ones((3, 1)))[0] > 1.0


def held(rng: np.random.Generator, samples: int, longest: int) -> np.ndarray:
    """Random levels between -1 and 1, each held for a random time."""
    lengths = rng.integers(max(1, longest // 5), longest + 1, samples)
    return np.repeat(rng.uniform(-1.0, 1.0, samples), lengths)[:samples, None]


def lagged(u: np.ndarray) -> np.ndarray:
    y = np.zeros_like(u)
    for t in range(1, len(u)):
        y[t] = 0.8 * y[t - 1] + 0.2 * u[t - 1]
    return y


@pytest.mark.parametrize(
    ("scale", "longest", "least", "most"),
    [(1.0, 20, 0.0, 0.1), (1.5, 20, 0.1, 1.0), (1.0, 3, 0.1, 1.0), (0.5, 20, 0.0, 0.1)],
)
def test_larger_and_faster_inputs_are_outside(
    scale: float, longest: int, least: float, most: float
) -> None:
    shares = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u = held(rng, 1000, 20)
        region = region_of([(u, lagged(u))])
        new = scale * held(rng, 800, longest)
        shares.append(np.mean(region.distance(new[:0], new, lagged(new)) > 1.0))
    assert least <= min(shares)
    assert max(shares) <= most


def test_a_window_without_a_past_changes_as_usual() -> None:
    rng = np.random.default_rng(8)
    u = held(rng, 2000, 20)
    y = lagged(u)
    region = region_of([(u, y)])
    starts = range(100, 1900, 50)
    shares = [np.mean(region.distance(u[:0], u[s : s + 50], y[s : s + 50]) > 1.0) for s in starts]
    assert np.mean(shares) < 0.1


def folds_of(scales: tuple[float, ...], samples: int = 400) -> list[HeldOutErrors]:
    rng = np.random.default_rng(1)
    return [HeldOutErrors((scale * rng.normal(size=(samples, 1)),)) for scale in scales]


def test_bands_of_equal_folds_stay_as_they_are() -> None:
    found = calibrate(folds_of((1.0, 1.0, 1.0)), 0.9)
    assert found.factor[0] == pytest.approx(1.0, abs=0.05)
    assert found.held.mean() == pytest.approx(0.9, abs=0.02)
    assert found.withdrawn == ("",)


def test_bands_are_widened_where_the_folds_differ_a_little() -> None:
    found = calibrate(folds_of((1.0, 1.1, 1.35)), 0.9)
    assert found.factor[0] > 1.01
    assert found.held.mean() == pytest.approx(0.9, abs=0.02)
    assert found.withdrawn == ("",)


@pytest.mark.parametrize(
    ("folds", "reason"),
    [
        (folds_of((1.0, 1.0, 4.0)), "are too few, or not alike in all parts"),
        (folds_of((1.0, 1.0, 1.0), samples=8), "are too few, or not alike in all parts"),
        (folds_of((1.0,)), "a single fold cannot check a band"),
    ],
)
def test_bands_that_nobody_can_check_are_withdrawn(folds: list[HeldOutErrors], reason: str) -> None:
    assert reason in calibrate(folds, 0.9).withdrawn[0]


def test_the_check_of_bands_does_not_depend_on_units() -> None:
    folds = folds_of((1.0, 1.1, 1.35))
    small = [HeldOutErrors(tuple(1e-9 * block for block in fold.blocks)) for fold in folds]
    np.testing.assert_allclose(calibrate(small, 0.9).factor, calibrate(folds, 0.9).factor)
