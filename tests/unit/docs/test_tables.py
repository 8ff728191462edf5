"""Tables of the documents are whole: each row has as many cells as the header."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.docs.test_paths import ROOT, name

PAGES = sorted(
    {*ROOT.glob("*.md")}
    | {
        page
        for folder in ("docs", "examples", "benchmarks")
        for page in ROOT.glob(f"{folder}/**/*.md")
    }
)
RULE = re.compile(r"\|?\s*:?-+:?\s*(\|\s*:?-+:?\s*)*\|?")


def cells(row: str) -> int:
    """Number of cells; a bar in a cell is written with a backslash."""
    return len(re.findall(r"(?<!\\)\|", row.strip().strip("|"))) + 1


def faults(text: str) -> Iterator[str]:
    """Rows without a header, such as those after a blank line, and rows of another length."""
    table: list[str] = []
    for line in [
        *re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE).splitlines(),
        "",
    ]:
        if line.lstrip().startswith("|"):
            table.append(line)
            continue
        if table and (len(table) < 3 or not RULE.fullmatch(table[1].strip())):
            yield f"no header, no rule or no rows: {table[0]}"
        yield from (
            f"{cells(row)} cells, not {cells(table[0])}: {row}"
            for row in table
            if cells(row) != cells(table[0])
        )
        table = []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_tables_are_whole(page: Path) -> None:
    assert list(faults(page.read_text())) == []


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("| a | b |\n|---|---|\n| 1 | 2 |\n", 0),
        ("| a | b |\n|---|---|\n| 1 | 2 \\| 3 |\n", 0),
        ("| a | b |\n|---|---|\n| 1 | 2 |\n\n| 3 | 4 |\n", 1),
        ("| a | b |\n|---|---|\n| 1 | 2 | 3 |\n| 1 |\n", 2),
    ],
)
def test_broken_tables_are_found(text: str, count: int) -> None:
    assert len(list(faults(text))) == count
