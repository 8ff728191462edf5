"""Parquet, Arrow and Feather."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from asia.data.intake.extras import need
from asia.data.intake.sheet import (
    Cells,
    Column,
    FileFormat,
    Sheet,
    Wanted,
    as_objects,
    find_column,
)
from asia.data.intake.stamps import time_column
from asia.errors import UserError

_ROWS = 262_144


class Arrow(FileFormat):
    """Read batch by batch, and only the requested columns, to save memory."""

    name = "Parquet and Arrow"
    suffixes: ClassVar[tuple[str, ...]] = (".parquet", ".pq", ".arrow", ".feather", ".ipc")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        file = _open(path)
        empty = {n: Column(np.zeros(0, _kind(t))) for n, t in file.types.items()}
        names = {find_column(list(empty), n) for n in wanted.names}
        names |= {n for n in empty if n.casefold() in ("date", "datum")} if wanted.names else set()
        names.add(time_column(Sheet(path.stem, empty, where=str(path)), wanted))
        kept = [n for n in empty if n in names]
        if not wanted.names or not all(find_column(list(empty), n) for n in wanted.names):
            return (Sheet(path.stem, empty, where=str(path)),)
        columns = {n: Column(cells) for n, cells in _collect(file, kept, path, wanted).items()}
        return (Sheet(path.stem, columns, where=str(path)),)


class _Batches:
    """A file of batches.

    Args:
        types: of Arrow, by column
        rows: number of them
    """

    def __init__(self, types: Mapping[str, Any], rows: int, batches: Any) -> None:
        self.types = types
        self.rows = rows
        self.batches = batches


def _open(path: Path) -> _Batches:
    pyarrow = need("pyarrow", path, "intake")
    try:
        if path.suffix.lower() in (".parquet", ".pq"):
            parquet: Any = need("pyarrow.parquet", path, "intake")
            file: Any = parquet.ParquetFile(path)
            schema: Any = file.schema_arrow
            types = dict(zip(schema.names, schema.types, strict=True))
            return _Batches(
                types,
                file.metadata.num_rows,
                lambda names: file.iter_batches(batch_size=_ROWS, columns=names),
            )
        dataset: Any = need("pyarrow.dataset", path, "intake")
        opened: Any = dataset.dataset(path, format="feather")
        types = dict(zip(opened.schema.names, opened.schema.types, strict=True))
        return _Batches(
            types,
            opened.count_rows(),
            lambda names: opened.to_batches(columns=names, batch_size=_ROWS, use_threads=False),
        )
    except (OSError, pyarrow.lib.ArrowException) as error:
        raise UserError(f"{path} does not read as Parquet or Arrow: {error}") from None


def _kind(kind: Any) -> str:
    text = str(kind)
    if text.startswith(("timestamp", "date")):
        return "datetime64[ns]"
    return "float64" if text.startswith(("int", "uint", "float", "double", "half")) else "object"


def _collect(file: _Batches, names: list[str], path: Path, wanted: Wanted) -> dict[str, Cells]:
    """The columns, filled batch by batch."""
    kinds = {n: _kind(file.types[n]) for n in names}
    found = {n: np.empty(file.rows, dtype=kinds[n]) for n in names}
    done = 0
    batches: Iterator[Any] = file.batches(names)
    for batch in batches:
        for name in names:
            found[name][done : done + batch.num_rows] = _cells(batch.column(name), kinds[name])
        done += batch.num_rows
        if file.rows > _ROWS:
            wanted.progress(f"{path.name}: {done / file.rows:.0%} of {file.rows} rows")
    return found


def _cells(array: Any, kind: str) -> Cells:
    if kind == "object":
        return as_objects(array.to_pylist())
    values = np.asarray(array.to_numpy(zero_copy_only=False))
    return values.astype(kind)
