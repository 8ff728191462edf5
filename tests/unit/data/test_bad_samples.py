"""Bad samples are found, named by record, row and time, and taken for missing on request."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.data.bad_samples import BadSamples, find_bad_samples
from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Missing, Wanted
from asia.errors import UserError
from asia.problem.create import init_problem
from asia.problem.load import load_problem

COUNT = 600


def clean(seed: int, hold: int = 1, digits: int = 4) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=COUNT // hold + 1), hold)[:COUNT]
    y = np.zeros(COUNT)
    for k in range(1, COUNT):
        y[k] = 0.8 * y[k - 1] + u[k - 1]
    return u, np.round(y + 0.02 * rng.normal(size=COUNT), digits)


def found(u: Array, y: Array, **options: Any) -> list[BadSamples]:
    record = Trajectory(u[:, None], y[:, None], 0.5, "r")
    return list(find_bad_samples([record], ["u"], ["y"], **options))


@pytest.mark.parametrize("seed", range(2))
def test_clean_records_have_none(seed: int) -> None:
    assert found(*clean(seed)) == []
    assert found(*clean(seed, hold=40)) == []
    # A quantised sensor rests while a step test holds the input.
    assert found(*clean(seed, hold=60, digits=0)) == []


def test_a_limit_and_an_initial_rest_are_no_faults() -> None:
    u, y = clean(1, hold=5)
    assert found(u, np.minimum(y, 1.0)) == []
    y[:80] = 0.0
    assert found(u, y) == []


def test_each_fault_is_named_by_row_and_time() -> None:
    u, y = clean(2)
    faults = {"outlier": y.copy(), "code": y.copy(), "frozen": y.copy()}
    faults["outlier"][200] += 60.0
    faults["code"][200] = 999.9
    faults["frozen"][200:260] = y[200]
    for kind, values in faults.items():
        (one,) = found(u, values)
        assert (one.kind, one.first, one.time) == (kind, 201, 100.0)
        assert f"row{'s 201 to 260' if kind == 'frozen' else ' 201'} of record 'r'" in str(one)
    assert one.last == 260


def test_a_counter_that_overflows_is_named() -> None:
    counter = np.cumsum(np.random.default_rng(0).integers(1, 6, COUNT))
    u, _ = clean(3)
    wrapped = np.where(counter >= 1024, counter - 1024, counter).astype(float)
    (one,) = [b for b in found(u, wrapped) if b.kind == "overflow"]
    assert (one.first - 1, one.statistic) == (int(np.argmax(counter >= 1024)), 1024.0)
    square = 256.0 * (np.arange(COUNT) // 20 % 2)
    assert found(u, square) == []


def test_outputs_of_a_test_are_left_alone() -> None:
    u, y = clean(4)
    y[200], u[300] = 999.9, -9999.0
    (one,) = found(u, y, only_inputs=True)
    assert (one.signal, one.first) == ("input u", 301)


def write(path: Path, y: Array, u: Array) -> Path:
    lines = [f"{k / 2},{a},{b}" for k, (a, b) in enumerate(zip(u, y, strict=True))]
    path.write_text("\n".join(["t,u,y", *lines, ""]))
    return path


def test_codes_ranges_and_rows_count_as_missing(tmp_path: Path) -> None:
    u, y = clean(5)
    y[[50, 60]] = 999.9, 80.0
    path = write(tmp_path / "r.csv", y, u)
    entries = (Missing(code=999.9), Missing("y", max=50.0), Missing("y", record="r", rows=(11, 13)))
    (record,) = take_in([path], Wanted(("u",), ("y",), missing=entries), "train").records
    assert np.flatnonzero(~record.measured[:, 0]).tolist() == [10, 11, 12, 50, 60]
    with pytest.raises(UserError, match="names rows of input 'u'"):
        take_in([path], Wanted(("u",), ("y",), missing=(Missing("u", rows=(1, 2)),)), "train")
    with pytest.raises(UserError, match="names 'z', which is no signal"):
        take_in([path], Wanted(("u",), ("y",), missing=(Missing("z", code=1.0),)), "train")


def test_a_problem_file_names_missing_samples(tmp_path: Path) -> None:
    u, y = clean(6)
    y[50] = 999.9
    path = write(tmp_path / "r.csv", y, u)
    made = init_problem(tmp_path / "a", train=[path], test=[], inputs=["u"], outputs=["y"])
    assert [one.first for one in made.bad] == [51]
    coded = Wanted((), (), missing=(Missing(code=999.9),))
    made = init_problem(
        tmp_path / "b", train=[path], test=[], inputs=["u"], outputs=["y"], wanted=coded
    )
    assert made.bad == ()
    assert "missing = [{ code = 999.9 }]" in made.path.read_text()
    assert "sampled every 0.5 s: column t" in "".join(load_problem(tmp_path / "b").readings)
    text = (tmp_path / "a" / "problem.toml").read_text()
    table = '[[data.missing]]\nsignal = "y"\nrecord = "r"\nrows = [51, 51]\n\n[protocol]'
    (tmp_path / "a" / "problem.toml").write_text(text.replace("[protocol]", table))
    for name in ("a", "b"):
        (record,) = load_problem(tmp_path / name).train
        assert np.flatnonzero(~record.measured[:, 0]).tolist() == [50]


def test_masks_are_missing_and_complex_numbers_are_refused() -> None:
    masked = np.ma.masked_greater(np.arange(6.0), 4.0)
    record = Trajectory(np.ones(6), masked, 1.0, "r")  # pyright: ignore[reportArgumentType]
    assert record.measured[:, 0].tolist() == [True] * 5 + [False]
    with pytest.raises(UserError, match="outputs of record 'r' holds complex numbers"):
        Trajectory(np.ones(6), np.ones(6) + 1j, 1.0, "r")  # pyright: ignore[reportArgumentType]
