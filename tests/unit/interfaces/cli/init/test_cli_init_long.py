"""Long records: taken in once, by blocks, with progress."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asia.data import Trajectory
from asia.data.intake.sheet import FileTable, Wanted
from asia.data.intake.text import Text
from asia.problem.create import RecordRows, record_csv
from asia.problem.load import load_problem
from tests.unit.interfaces.cli.conftest import Asia

ROWS = 300_000


def test_blocks_of_a_record_are_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(0).normal(size=(10, 2))
    record = Trajectory(values[:, :1], values[:, 1:], 1.0, "r")
    whole = record_csv(record, ["u", "y"])
    told: list[str] = []
    monkeypatch.setattr("asia.problem.create._BLOCK", 4)
    assert "".join(RecordRows(record, ["u", "y"], told.append).blocks()) == whole
    assert told == ["writing r: 40% of 10 rows", "writing r: 80% of 10 rows"]


@pytest.mark.slow
def test_a_long_parquet_file_is_never_read_as_text(
    asia: Asia, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    u = np.sin(0.01 * np.arange(ROWS))
    table = arrow.table({"t": 0.5 * np.arange(ROWS), "u": u, "y": 2.0 * u})
    parquet.write_table(table, tmp_path / "long.parquet")

    parse = Text.parse

    def refused(self: Text, path: Path, raw: bytes, wanted: Wanted) -> FileTable:
        assert path.suffix != ".parquet"
        return parse(self, path, raw, wanted)

    monkeypatch.setattr(Text, "parse", refused)
    monkeypatch.setattr("asia.interfaces.cli.init._SILENT_SECONDS", 0.0)
    directory = tmp_path / "long"
    done = asia(
        "init", str(directory), "--train", str(tmp_path / "long.parquet"),
        "--inputs", "u", "--outputs", "y",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert f"of {ROWS} rows" in done.err
    (record,) = load_problem(directory).train
    assert np.array_equal(record.y[:, 0], 2.0 * u)
