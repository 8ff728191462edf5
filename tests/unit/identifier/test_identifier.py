"""An estimator over a search, and a run as a table."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import asia
from asia.data import Array
from asia.errors import UserError
from asia.identifier._records import check_times, sampling_time_of
from asia.search import BandedSimulation
from tests.unit.cli.conftest import command_line

STEP = 0.5


def a_record(seed: int, samples: int = 160) -> tuple[Array, Array]:
    """Of a first-order system, nearly free of noise."""
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


@pytest.mark.long
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
    assert (banded.lower < banded.upper).all()


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_same_records_and_settings_resume(fitted: asia.SystemIdentifier) -> None:
    again = asia.SystemIdentifier(**fitted.get_params())
    records = [a_record(1), a_record(2)]
    again.fit([u for u, _ in records], [y for _, y in records], sampling_time=STEP)
    assert again.run_.directory == fitted.run_.directory
    assert again.run_.lines == fitted.run_.lines


@pytest.mark.long
def test_the_command_line_finds_the_same(fitted: asia.SystemIdentifier, tmp_path: Path) -> None:
    directory = next((Path(fitted.runs) / "problems").glob("records-*"))
    done = command_line(
        "run", directory, "--experiments", "1", "--seed", "0", "--runs", tmp_path, "--json"
    )
    assert done.code == 0
    (there,) = tmp_path.glob("*/ledger.jsonl")
    view = asia.open_run(there.parent).view
    assert [e.score for e in view.finished] == [e.score for e in fitted.run_.view.finished]
    assert view.experiments[0].proposed == fitted.run_.view.experiments[0].proposed


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


@pytest.mark.slow
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


def test_the_sampling_time_is_that_of_the_index() -> None:
    times = [datetime(2026, 1, 1) + timedelta(milliseconds=20 * k) for k in range(50)]
    frame = pd.DataFrame({"u": np.zeros(50)}, index=pd.DatetimeIndex(times))
    assert sampling_time_of([frame, np.zeros(3)], None) == pytest.approx(0.02)
    assert sampling_time_of([frame], 0.02) == 0.02
    with pytest.raises(UserError, match=r"steps of 0\.02 s"):
        sampling_time_of([frame], 0.1)
    with pytest.raises(UserError, match=r"not equally spaced: 0\.04 s after row 9, 0\.02 s"):
        sampling_time_of([frame.drop(frame.index[10])], None)
    with pytest.raises(UserError, match=r"different steps \(0\.02 s, 0\.04 s\)"):
        sampling_time_of([frame, frame[::2]], None)
    with pytest.raises(UserError, match="give sampling_time"):
        sampling_time_of([np.zeros(3)], None)


def test_inputs_and_outputs_begin_at_the_same_time() -> None:
    times = pd.date_range("2026-01-01", periods=50, freq="20ms")
    u = pd.DataFrame({"u": np.zeros(50)}, index=times)
    check_times([u], [u + 1.0])
    check_times([np.zeros(3)], [u])
    with pytest.raises(UserError, match=r"record 2: the time index of y begins 0\.04 s away"):
        check_times([u, u[:-2]], [u, u[2:]])
