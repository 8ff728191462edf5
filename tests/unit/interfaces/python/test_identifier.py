"""An estimator over a search, and a run as a table."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import asia
from asia.analysis.verdict import usability
from asia.data import Array, Signal
from asia.data.arrays import read_arrays
from asia.data.intake.conversion import Intake, Use
from asia.errors import UserError
from asia.search.simulation import BandedSimulation

pytestmark = pytest.mark.slow

STEP = 0.5


def a_record(seed: int, samples: int = 160) -> tuple[Array, Array]:
    """Records of a first-order system, nearly free of noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=samples), np.zeros(samples)
    for k in range(1, samples):
        y[k] = 0.7 * y[k - 1] + 0.5 * u[k - 1]
    return u, y + 1e-3 * rng.normal(size=samples)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> asia.SystemIdentifier:
    """The baseline alone, fitted to two records."""
    found = asia.SystemIdentifier(
        1, runs=tmp_path_factory.mktemp("runs"), progress=False, budget={"retests": 0}
    )
    records = [a_record(1), a_record(2)]
    return found.fit([u for u, _ in records], [y for _, y in records], sampling_time=STEP)


def test_it_simulates_predicts_and_scores(fitted: asia.SystemIdentifier) -> None:
    u, y = a_record(3)
    assert fitted.score(u, y) > 99.0
    assert fitted.score([u, u[:80]], [y, y[:80]]) > 99.0
    simulated = fitted.simulate(u[40:], past_u=u[:40], past_y=y[:40])
    assert isinstance(simulated, np.ndarray)
    assert simulated.shape == (len(u) - 40, 1)
    assert np.abs(simulated[:, 0] - y[40:]).max() < 0.02
    banded = fitted.simulate(u[40:], past_u=u[:40], past_y=y[:40], bands=0.9)
    assert isinstance(banded, BandedSimulation)
    # Two short records say too little of the bands.
    assert (banded.y_hat == simulated).all()
    assert "the errors are too few" in banded.withdrawn[0]
    assert np.isnan(banded.lower).all()


def test_a_prediction_stands_at_its_sample_and_uses_nothing_later(
    fitted: asia.SystemIdentifier,
) -> None:
    u, y = a_record(4, 60)
    past = fitted.problem_.protocol.past
    found = fitted.predict(u, y, horizon=3)
    assert np.isnan(found[: past + 2]).all()
    assert np.abs(found[past + 2 :, 0] - y[past + 2 :]).max() < 0.02
    case = {"past_u": u[: past + 4], "past_y": y[: past + 4]}
    simulated = fitted.simulate(u[past + 4 : past + 7], **case)
    assert isinstance(simulated, np.ndarray)
    assert found[past + 6] == pytest.approx(simulated[-1], abs=1e-12)
    u[past + 7 :], y[past + 4 :] = 9.0, 9.0
    again = fitted.predict(u, y, horizon=3)
    assert again[past + 6] == pytest.approx(found[past + 6], abs=1e-12)


def test_the_same_records_and_settings_resume(fitted: asia.SystemIdentifier) -> None:
    again = asia.SystemIdentifier(**fitted.get_params())
    records = [a_record(1), a_record(2)]
    again.fit([u for u, _ in records], [y for _, y in records], sampling_time=STEP)
    assert again.run_.directory == fitted.run_.directory
    assert again.run_.lines == fitted.run_.lines


def test_parameters_are_those_of_the_constructor() -> None:
    given = asia.SystemIdentifier(3, seed=4, budget={"fit_seconds": 5})
    assert given.get_params()["seed"] == 4
    assert repr(given) == "SystemIdentifier(experiments=3, seed=4, budget={'fit_seconds': 5})"
    assert "seed=4" in given._repr_html_()
    with pytest.raises(UserError, match=r"no parameter 'sed'; there are experiments, agent"):
        given.set_params(sed=1)
    with pytest.raises(UserError, match="call fit"):
        given.score(*a_record(1))


def test_what_is_asked_wrongly_is_refused(fitted: asia.SystemIdentifier) -> None:
    u, y = a_record(5)
    with pytest.raises(UserError, match="past_u is missing: the model starts from the 10 samples"):
        fitted.simulate(u)
    with pytest.raises(UserError, match=r"u has shape \(80, 2\), expected \(samples, 1\)"):
        fitted.simulate(u.reshape(-1, 2), past_u=u, past_y=y)
    with pytest.raises(UserError, match="horizon is 0"):
        fitted.predict(u, y, horizon=0)
    with pytest.raises(UserError, match="record1 has 8 samples"):
        fitted.score(u[:8], y[:8])


def test_a_notebook_shows_value_model_and_picture(fitted: asia.SystemIdentifier) -> None:
    text = fitted._repr_html_()
    assert "model to use" in text
    assert "data:image/png;base64," in text
    assert f"{fitted.value_:.4f}" in text
    assert "def fit" in fitted.source_


def test_the_model_is_exported(fitted: asia.SystemIdentifier, tmp_path: Path) -> None:
    (written,) = fitted.export("numpy", tmp_path)
    assert written.folder == tmp_path / "numpy"
    assert max(row.difference for row in written.parity) < 1e-9
    with pytest.raises(UserError, match="numpi"):
        fitted.export("numpi", tmp_path)


def test_a_run_as_a_table(fitted: asia.SystemIdentifier) -> None:
    frame = asia.load_run(fitted.run_.directory)
    assert list(frame.index) == [1]
    assert frame.loc[1, "V"] == fitted.value_
    assert frame.loc[1, "status"] == "keep"
    assert {"V_fold1", "V_fold2", "hypothesis"} <= set(frame.columns)
    assert frame.attrs["best"] == 1
    assert asia.load_run(runs=fitted.runs).equals(frame)


def test_a_run_is_named_by_itself_and_prints_short(fitted: asia.SystemIdentifier) -> None:
    assert asia.load_run(fitted.run_).equals(asia.load_run(fitted.run_.directory))
    assert len(repr(fitted.run_)) < 300
    assert fitted.run_.name in repr(fitted.run_)
    assert "1 experiments, best #1 V=" in repr(fitted.run_)


def test_parameters_are_a_data_frame_where_pandas_is_installed(
    fitted: asia.SystemIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = fitted.parameters_
    assert isinstance(frame, pd.DataFrame)
    ends = frame[["low", "high"]].to_numpy()
    assert frame.index.name == "parameter"
    assert list(frame.columns) == [
        "value", "unit", "standard_error", "low", "high", "fold_error", "lower", "upper",
        "identifiable",
    ]  # fmt: skip
    monkeypatch.setitem(sys.modules, "pandas", None)
    plain = fitted.parameters_
    assert isinstance(plain, tuple)
    assert [one.fitted.name for one in plain] == list(frame.index)
    assert [one.fitted.value for one in plain] == frame["value"].tolist()
    assert plain
    intervals = [one.interval or (np.nan, np.nan) for one in plain]
    np.testing.assert_array_equal(ends, np.array(intervals))
    assert fitted.verdict_ == usability(asia.open_run(fitted.run_.directory).view)


def read(
    u: Sequence[Any], y: Sequence[Any], step: float | None = None, use: Use = "train"
) -> Intake:
    return read_arrays(u, y, [Signal("u")], [Signal("y")], step, "record", use)


def frame_of(index: Any, name: str) -> pd.DataFrame:
    return pd.DataFrame({name: np.sin(np.arange(len(index)))}, index=index)


@pytest.mark.parametrize(
    "index",
    [
        pd.date_range("2026-01-01", periods=50, freq="20ms"),
        pd.date_range("2026-01-01", periods=50, freq="20ms", tz="Europe/Berlin"),
        pd.timedelta_range(0, periods=50, freq="20ms"),
        pd.Index(np.arange(50) * 0.02),
        pd.Index(np.arange(50) * 20, name="time_ms"),
        pd.Index([str(t) for t in pd.date_range("2026-01-01", periods=50, freq="20ms")], name="t"),
    ],
)
def test_the_sampling_time_is_that_of_the_index(index: Any) -> None:
    u, y = frame_of(index, "u"), frame_of(index, "y")
    for pair in ((u, y), (u, y.to_numpy()), (u.to_numpy(), y)):
        found = read([pair[0]], [pair[1]])
        assert found.records[0].sampling_time == pytest.approx(0.02)
        assert len(found.records[0]) == 50
        assert found.notes == ()


def test_an_index_that_numbers_the_rows_is_no_time() -> None:
    u, y = frame_of(pd.RangeIndex(50), "u"), frame_of(pd.Index(np.arange(50) * 2), "y")
    assert len(read([u], [y], 0.1).records[0]) == 50
    with pytest.raises(UserError, match="give sampling_time"):
        read([u], [y])


def test_an_index_has_the_rules_of_a_column_of_time_stamps() -> None:
    rng = np.random.default_rng(0)
    jittered = np.arange(200) * 0.1 + 0.001 * rng.standard_normal(200)
    u, y = frame_of(pd.Index(jittered), "u"), frame_of(pd.Index(jittered), "y")
    found = read([u], [y])
    assert found.records[0].sampling_time == pytest.approx(0.1)
    assert "resampled to 0.1 s" in found.notes[0]
    with pytest.raises(UserError, match=r"never interpolated: bring .* drop the index"):
        read([u], [y], use="test")
    gap = np.delete(np.arange(60) * 0.1, 30)
    cut = read([frame_of(pd.Index(gap), "u")], [frame_of(pd.Index(gap), "y")])
    assert [len(r) for r in cut.records] == [30, 29]
    with pytest.raises(UserError, match=r"sampled every 0\.1 s, but the sampling time is 0\.02 s"):
        read([frame_of(pd.Index(gap), "u")], [frame_of(pd.Index(gap), "y")], 0.02)
    missing = np.sin(np.arange(50.0))
    missing[20] = np.nan
    assert [len(r) for r in read([missing], [missing], 0.1).records] == [20, 29]


def test_inputs_and_outputs_have_the_same_times() -> None:
    times = pd.date_range("2026-01-01", periods=50, freq="20ms")
    u, y = frame_of(times, "u"), frame_of(times, "y")
    with pytest.raises(UserError, match=r"'record2': the time index of y is 0\.04 s away"):
        read([u, u[:-2]], [y, y[2:]])
