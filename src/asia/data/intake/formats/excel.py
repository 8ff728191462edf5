"""Excel."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar
from zipfile import BadZipFile

from asia.data.intake.extras import need
from asia.data.intake.numbers import number
from asia.data.intake.sheet import (
    Column,
    FileFormat,
    Sheet,
    Wanted,
    as_objects,
    find_column,
    split_unit,
)
from asia.errors import UserError


class Excel(FileFormat):
    """Each worksheet that has the wanted columns is a record."""

    name = "Excel"
    suffixes: ClassVar[tuple[str, ...]] = (".xlsx", ".xlsm")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        openpyxl = need("openpyxl", path, "intake")
        try:
            book: Any = openpyxl.load_workbook(path, read_only=True, data_only=True)
        except (OSError, KeyError, ValueError, BadZipFile) as error:
            raise UserError(f"{path} does not read as an Excel workbook: {error}") from None
        many = len(book.worksheets) > 1
        found: list[Sheet] = []
        for page in book.worksheets:
            rows = [row for row in page.iter_rows(values_only=True) if _filled(row)]
            name = page.title if many else path.stem
            where = f"{path}, worksheet {page.title}" if many else str(path)
            sheet = _sheet(rows, name, where, wanted)
            if sheet is not None:
                found.append(sheet)
        book.close()
        if not found:
            raise UserError(f"{path} is empty: expected a header row, then numbers")
        full = [s for s in found if all(find_column(list(s.columns), n) for n in wanted.names)]
        return tuple(full or found[:1])


def _filled(row: tuple[Any, ...]) -> bool:
    return any(cell is not None and str(cell).strip() for cell in row)


def _is_head(row: tuple[Any, ...]) -> bool:
    cells = [c for c in row if c is not None]
    return all(isinstance(c, str) and number(c) is None for c in cells)


def _sheet(rows: list[tuple[Any, ...]], name: str, where: str, wanted: Wanted) -> Sheet | None:
    first = next((k for k, row in enumerate(rows) if not _is_head(row)), None)
    if first is None:
        return None
    wide = max(len(row) for row in rows[first:])
    units = [""] * wide
    if wanted.columns:
        labels = list(wanted.columns)
        if len(labels) != wide:
            raise UserError(f"{where} has {wide} columns, but --columns names {len(labels)}")
    else:
        heads = [_texts(row, wide) for row in rows[max(first - 2, 0) : first]]
        if not heads:
            raise UserError(
                f"{where}: the first row holds numbers: add a header row with the column names, or "
                "give --columns"
            )
        wished = set(wanted.names)
        hits = [sum(split_unit(c)[0] in wished for c in row) for row in heads]
        top = 0 if len(heads) == 1 or hits[0] >= max(hits[1], 1) else 1
        labels = heads[top]
        units = [u.strip("[]() ") for u in heads[top + 1]] if top + 1 < len(heads) else units
    units = [u or split_unit(n)[1] for u, n in zip(units, labels, strict=True)]
    padded = [(*row, *[None] * (wide - len(row))) for row in rows[first:]]
    cells = zip(*padded, strict=True)
    columns = {
        n: Column(as_objects(c), u) for n, u, c in zip(labels, units, cells, strict=True) if n
    }
    return Sheet(name, columns, None, where, first + 1)


def _texts(row: tuple[Any, ...], wide: int) -> list[str]:
    texts = ["" if c is None else str(c).strip() for c in row[:wide]]
    return texts + [""] * (wide - len(texts))
