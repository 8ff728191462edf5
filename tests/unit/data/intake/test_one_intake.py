"""The same file gives the same records by `asia init`, by problem.toml, by `asia validate --record`
and by arrays."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
from asia.data.intake.records import survey

from asia.data import Signal, Trajectory, data_digest
from asia.data.arrays import read_arrays
from asia.data.intake.sheet import Wanted
from asia.errors import UserError
from asia.problem.create import init_problem, record_csv
from asia.problem.load import load_problem, read_records
from asia.problem.seal import open_test

COUNT, STEP = 150, 0.1
Write = Callable[[Path, Trajectory], None]


def record(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.round(rng.normal(size=(COUNT, 2)), 3)
    return Trajectory(u, np.round(u @ [[1.0], [2.0]] + rng.normal(size=(COUNT, 1)), 3), STEP)


def stamps() -> list[float]:
    return (np.arange(COUNT) * STEP).round(9).tolist()


def german(path: Path, r: Trajectory) -> None:
    rows = np.column_stack([stamps(), r.u, r.y]).tolist()
    lines = [";".join(f"{v}".replace(".", ",") for v in row) for row in rows]
    path.write_text("\n".join(["Zeit;u1;u2;y", *lines, ""]))


def mat(path: Path, r: Trajectory) -> None:
    scipy.io.savemat(path, {"run": {"u": r.u, "y": r.y, "Ts": STEP}})


def mat_hdf5(path: Path, r: Trajectory) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("run")
        group["u"], group["y"], group["Ts"] = r.u.T, r.y.T, np.array([[STEP]])
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def excel(path: Path, r: Trajectory) -> None:
    book = openpyxl.Workbook()
    page = book.active
    assert page is not None
    page.append(["Zeit", "u1", "u2", "y"])
    for t, u, y in zip(stamps(), r.u.tolist(), r.y.tolist(), strict=True):
        page.append([datetime(2026, 3, 1) + timedelta(seconds=t), *u, *y])
    book.save(path)


def parquet(path: Path, r: Trajectory) -> None:
    columns = {"t": stamps(), "u1": r.u[:, 0], "u2": r.u[:, 1], "y": r.y[:, 0]}
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


FORMATS = [
    (".csv", german, ("u1", "u2")),
    (".mat", mat, ("u",)),
    (".mat", mat_hdf5, ("u",)),
    (".xlsx", excel, ("u1", "u2")),
    (".parquet", parquet, ("u1", "u2")),
]


def problem_toml(folder: Path, data: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "problem.toml").write_text(
        f'sampling_time = {STEP}\ninputs = ["u1", "u2"]\noutputs = ["y"]\n[data]\n{data}\n'
    )
    return folder


def digest_of_test(folder: Path) -> str:
    return data_digest(open_test(load_problem(folder)))


@pytest.mark.parametrize(("suffix", "write", "inputs"), FORMATS)
def test_every_way_reads_every_format(
    tmp_path: Path, suffix: str, write: Write, inputs: tuple[str, ...]
) -> None:
    a, b = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write(a, record(1))
    write(b, record(2))
    made = init_problem(tmp_path / "made", train=[a], test=[b], inputs=inputs, outputs=["y"])
    text = f'train = ["../a{suffix}"]\ntest = ["../b{suffix}"]'
    written = problem_toml(tmp_path / "written", text)
    for folder in (made.path.parent, written):
        problem = load_problem(folder)
        assert [s.name for s in problem.inputs] == ["u1", "u2"]
        assert data_digest(problem.train) == data_digest([record(1)])
        assert digest_of_test(folder) == data_digest([record(2)])
        assert data_digest(read_records(problem, b)) == data_digest([record(2)])


def wide(path: Path) -> None:
    rows = [
        ["run,t,u1,u2,y"],
        *[
            [f"{k},{t},{row}" for t, row in zip(stamps(), rows_of(record(k)), strict=True)]
            for k in (1, 2, 3)
        ],
    ]
    path.write_text("\n".join(line for part in rows for line in part))


def rows_of(r: Trajectory) -> list[str]:
    return record_csv(r, ["u1", "u2", "y"]).splitlines()[1:]


def test_one_experiment_of_a_wide_file_is_the_test(tmp_path: Path) -> None:
    wide(tmp_path / "wide.csv")
    made = init_problem(
        tmp_path / "made",
        train=[tmp_path / "wide.csv"],
        test=[],
        inputs=["u1", "u2"],
        outputs=["y"],
        test_experiments=["3"],
        wanted=Wanted((), (), experiment="run"),
    )
    data = 'train = ["../wide.csv"]\nexperiment_column = "run"\ntest_experiments = ["3"]'
    written = problem_toml(tmp_path / "written", data)
    for folder in (made.path.parent, written):
        problem = load_problem(folder)
        assert data_digest(problem.train) == data_digest([record(1), record(2)])
        assert digest_of_test(folder) == data_digest([record(3)])
    every = read_records(load_problem(written), tmp_path / "wide.csv")
    assert data_digest(every) == data_digest([record(1), record(2), record(3)])
    given = Wanted((), (), experiment="run")
    assert len(read_records(load_problem(made.path.parent), tmp_path / "wide.csv", given)) == 3
    assert load_problem(written).data.places("test") == ((tmp_path / "wide.csv").resolve(),)
    with pytest.raises(UserError, match=r"no experiment '4' in .* \(there are 1, 2, 3\)"):
        load_problem(problem_toml(tmp_path / "bad", data.replace('["3"]', '["4"]')))


def test_jitter_has_one_rule(tmp_path: Path) -> None:
    """1 % of a sample: resampled for training, refused as a test."""
    times = np.array(stamps()) + 0.01 * STEP * np.random.default_rng(0).normal(size=COUNT)
    for name, seed in (("a", 1), ("b", 2)):
        rows = [f"{t},{row}" for t, row in zip(times, rows_of(record(seed)), strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["t,u1,u2,y", *rows]))
    a, b = tmp_path / "a.csv", tmp_path / "b.csv"
    names = {"inputs": ["u1", "u2"], "outputs": ["y"]}
    frame = pd.read_csv(a).set_index("t")
    signals = [Signal("u1"), Signal("u2")], [Signal("y")]
    trained = read_arrays([frame], [frame], *signals, None, "r").records
    made = init_problem(tmp_path / "made", train=[a], test=[], **names)  # pyright: ignore
    written = problem_toml(tmp_path / "written", 'train = ["../a.csv"]')
    for folder in (made.path.parent, written):
        assert data_digest(load_problem(folder).train) == data_digest(trained)
    assert any("resampled" in w for w in load_problem(written).warnings)
    says = r"jitter by 2\.\d% of a sample, and outputs of a test are never interpolated: .*bring a"
    with pytest.raises(UserError, match=says):
        init_problem(tmp_path / "x", train=[a], test=[b], **names)  # pyright: ignore
    with pytest.raises(UserError, match=says):
        init_problem(tmp_path / "x", train=[a], test=[b], sampling_time=STEP, **names)  # pyright: ignore
    with pytest.raises(UserError, match=r"never interpolated: keep the last part .*--no-seal"):
        init_problem(tmp_path / "x", train=[a], test=[], seal_fraction=0.2, **names)  # pyright: ignore
    with pytest.raises(UserError, match=says):
        read_records(load_problem(written), b)
    with pytest.raises(UserError, match=says):
        read_arrays([frame], [frame], *signals, STEP, "r", "test")
    tested = problem_toml(tmp_path / "tested", 'train = ["../a.csv"]\ntest = ["../b.csv"]')
    with pytest.raises(UserError, match=says):
        digest_of_test(tested)
    ignored = problem_toml(
        tmp_path / "i", 'train = ["../a.csv"]\ntest = ["../b.csv"]\ntime = "none"'
    )
    assert digest_of_test(ignored) == data_digest([record(2)])


def test_a_matrix_in_a_problem_file_is_named_by_its_columns(tmp_path: Path) -> None:
    mat(tmp_path / "a.mat", record(1))
    folder = problem_toml(tmp_path / "mine", 'train = ["../a.mat"]')
    path = folder / "problem.toml"
    path.write_text(path.read_text().replace('["u1", "u2"]', '["u"]'))
    with pytest.raises(UserError, match=r"name the columns u1, u2, y in problem\.toml"):
        load_problem(folder)


def test_a_column_of_dates_is_the_time_whatever_its_name(tmp_path: Path) -> None:
    r, start = record(3), datetime(2024, 5, 3, 8)
    rows = [
        f"{start + timedelta(seconds=2 * k):%d.%m.%Y %H:%M:%S};{u[0]};{y[0]}"
        for k, (u, y) in enumerate(zip(r.u, r.y, strict=True))
    ]
    path = tmp_path / "messung.csv"
    path.write_text("\n".join(["Datum/Uhrzeit;u;y", *rows, ""]))
    found = survey(path, Wanted((), ()))
    assert found.time == "Datum/Uhrzeit"
    assert (list(found.inputs), list(found.outputs)) == (["u"], ["y"])
    path.write_text("\n".join(["a;u;y", *(f"12:30;{k}.5;{k}.25" for k in range(99)), ""]))
    assert survey(path, Wanted((), ())).time is None
