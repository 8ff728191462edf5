"""The clean record, written and read back in every format."""

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow
import pyarrow.feather
import pyarrow.parquet
import pytest
import scipy.io
from nptdms import ChannelObject, TdmsWriter

from asia.data import data_digest
from asia.data.intake.conversion import take_in
from asia.data.intake.formats import FORMATS
from asia.data.intake.sheet import Wanted
from asia.errors import UserError

from .clean import CLEAN, STEP, WANTED, digest, record, signals

T, U, Y = (np.array(v) for v in signals())
STAMPS = np.datetime64("2026-03-01T12:00:00", "ns") + (T * 1e9).astype("timedelta64[ns]")
COLUMNS = {"t": T, "u": U, "y": Y}


def npz(path: Path) -> None:
    np.savez(path, **COLUMNS)


def npz_matrix(path: Path) -> None:
    np.savez(path, t=T[:, None], u=U[:, None], y=Y[None, :])


def mat(version: str) -> Callable[[Path], None]:
    return lambda path: scipy.io.savemat(path, COLUMNS, format=version, oned_as="column")


def mat_struct(path: Path) -> None:
    scipy.io.savemat(path, {"run": {"data": {"u": U, "y": Y}, "Ts": STEP}, "note": "hello"})


def mat_hdf5(path: Path) -> None:
    """Write a file as MATLAB -v7.3: a user block, and columns as rows."""
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("run")
        for name, values in COLUMNS.items():
            group[name] = values[None, :]
    with path.open("r+b") as stream:
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
        stream.write(head)


def hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file[f"rig/{name}"] = values


def hdf5_table(path: Path) -> None:
    rows = np.rec.fromarrays([T, U, Y], names=["t", "u", "y"])
    with h5py.File(path, "w") as file:
        file["log"] = rows


def parquet(path: Path) -> None:
    pyarrow.parquet.write_table(pyarrow.table(COLUMNS | {"other": U}), path)


def parquet_dates(path: Path) -> None:
    pyarrow.parquet.write_table(pyarrow.table({"when": STAMPS, "u": U, "y": Y}), path)


def feather(path: Path) -> None:
    pyarrow.feather.write_feather(pyarrow.table(COLUMNS), path)


def excel(path: Path) -> None:
    book = openpyxl.Workbook()
    page = book.active
    assert page is not None
    page.append(["Rig 4", None, None])
    page.append(["t", "u", "y"])
    page.append(["s", "V", "m"])
    for row in zip(T.tolist(), U.tolist(), Y.tolist(), strict=True):
        page.append(row)
    book.save(path)


def excel_dates(path: Path) -> None:
    book = openpyxl.Workbook()
    page = book.active
    assert page is not None
    page.append(["Zeit", "u [V]", "y"])
    for t, u, y in zip(T.tolist(), U.tolist(), Y.tolist(), strict=True):
        page.append([datetime(2026, 3, 1) + timedelta(seconds=t), u, y])
    book.save(path)


def tdms(path: Path) -> None:
    shape: dict[str, Any] = {"wf_start_offset": 0.5, "wf_increment": STEP, "unit_string": "V"}
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [ChannelObject("rig", "u", U, shape), ChannelObject("rig", "y", Y, shape)]
        )


def tdms_time(path: Path) -> None:
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("rig", n, v) for n, v in COLUMNS.items()])


def mdf(path: Path) -> None:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        for name, values in (("u", U), ("y", Y)):
            file.append(Signal(values, T, unit="V", name=name))
        file.save(path)


WRITERS: list[tuple[str, Callable[[Path], None]]] = [
    ("log.npz", npz),
    ("log.npz", npz_matrix),
    ("log.mat", mat("4")),
    ("log.mat", mat("5")),
    ("log.mat", mat_struct),
    ("log.mat", mat_hdf5),
    ("log.h5", hdf5),
    ("log.h5", hdf5_table),
    ("log.parquet", parquet),
    ("log.parquet", parquet_dates),
    ("log.feather", feather),
    ("log.xlsx", excel),
    ("log.xlsx", excel_dates),
    ("log.tdms", tdms),
    ("log.tdms", tdms_time),
    ("log.mf4", mdf),
]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(("name", "write"), WRITERS)
def test_every_format_gives_the_same_digest(
    tmp_path: Path, name: str, write: Callable[[Path], None]
) -> None:
    path = tmp_path / name
    write(path)
    assert digest(path) == CLEAN


@pytest.mark.parametrize("kind", [k for k in FORMATS if k.suffixes[0] != ".csv"])
def test_a_file_with_a_wrong_suffix_is_refused(tmp_path: Path, kind: Any) -> None:
    path = tmp_path / f"log{kind.suffixes[0]}"
    path.write_bytes(b"this is a note, not a measurement")
    with pytest.raises(UserError, match="does not read as") as caught:
        digest(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("name", "write"), [WRITERS[k] for k in (0, 3, 6, 8, 11, 14)])
def test_a_missing_channel_is_named(
    tmp_path: Path, name: str, write: Callable[[Path], None]
) -> None:
    path = tmp_path / name
    write(path)
    with pytest.raises(UserError, match=r"no column 'speed' \(it has .*y.*\)"):
        digest(path, Wanted(("speed",), ("y",)))


def test_a_struct_array_is_many_records(tmp_path: Path) -> None:
    path = tmp_path / "runs.mat"
    runs = np.array([{"u": U, "y": Y, "Ts": STEP}, {"u": U[:50], "y": Y[:50], "Ts": STEP}])
    scipy.io.savemat(path, {"run": runs})
    found = take_in([path], WANTED, "train").records
    assert [(t.name, len(t)) for t in found] == [("run1", 60), ("run2", 50)]
    assert data_digest(found[:1]) == CLEAN


def test_a_matlab_object_is_refused_with_the_line_that_exports_it(tmp_path: Path) -> None:
    path = tmp_path / "z.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["z"] = np.zeros((1, 6), np.uint32)
        file["z"].attrs["MATLAB_object_decode"] = 3
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    with pytest.raises(UserError, match=r"iddata.*struct\('y', z\.y, 'u', z\.u, 'Ts', z\.Ts\)"):
        digest(path)


def test_channels_with_rasters_of_their_own(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    path = tmp_path / "log.mf4"
    with MDF(version="4.10") as file:
        file.append(Signal(U[::3], T[::3], name="u"))
        file.append(Signal(Y, T, name="y"))
        file.save(path)
    (made,) = take_in([path], WANTED, "train").records
    # The slower input is held; nothing is interpolated.
    assert np.array_equal(made.u[:58, 0], np.repeat(U[::3], 3)[:58])
    assert np.array_equal(made.y[:58], record().y[:58])


@pytest.mark.parametrize(("version", "x"), [("3.30", "X"), ("4.10", "X1")])
def test_a_formula_of_a_channel_is_computed_and_never_executed(
    tmp_path: Path, version: str, x: str
) -> None:
    from asammdf import MDF, Signal

    marker = tmp_path / "marker"
    code = f"(__import__('pathlib').Path({str(marker)!r}).touch() or 0) + {x}"
    for formula in (f"2 * {x} + 1", code):
        path = tmp_path / "log.mdf"
        with MDF(version=version) as file:
            raw = np.arange(len(T), dtype=np.uint16)
            file.append(Signal(raw, T, name="u", conversion={"formula": formula}))
            file.append(Signal(Y, T, name="y"))
            path = file.save(path, overwrite=True)
        marker.unlink(missing_ok=True)
        if formula is code:
            with pytest.raises(UserError, match="physical values"):
                take_in([path], WANTED, "train")
            assert not marker.exists()
        else:
            (made,) = take_in([path], WANTED, "train").records
            assert np.array_equal(made.u[:, 0], 2.0 * raw + 1.0)


def test_a_column_of_experiments_in_parquet(tmp_path: Path) -> None:
    path = tmp_path / "all.parquet"
    names = np.repeat(["a", "b"], 60)
    table = {"run": names, **{k: np.tile(v, 2) for k, v in COLUMNS.items()}}
    pyarrow.parquet.write_table(pyarrow.table(table), path)
    found = take_in([path], replace(WANTED, experiment="run"), "train").records
    assert [t.name for t in found] == ["a", "b"]
    assert data_digest(found[1:]) == CLEAN


def test_an_extra_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.h5"
    hdf5(path)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(UserError, match=r"pip install '\.\[intake\]'"):
        digest(path)
