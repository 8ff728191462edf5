"""Sources of records: one class a source, all derived from `Source`.

A source knows all records of a problem, in three subsets: `train`, `test` and `guard`. It reads
them, lists their files (which workers must not read), and writes itself as `[data]` of a problem
file. `SOURCES` has ASIA's own by name; an installed package adds one as an entry point of the group
`asia.sources`, and `data.source = "name:argument"` then names it. `asia.testing.check_source` is
the conformance suite of sources. Where training records are chosen by name, derive from `DataSet`.
"""

from collections.abc import Mapping
from pathlib import Path

from asia._plugins import parts_of
from asia._text import suggestion
from asia.data.intake.sheet import Wanted
from asia.data.sources.files import RecordFiles
from asia.data.sources.nanodrone import Nanodrone
from asia.data.sources.official import OfficialBenchmark
from asia.data.sources.sealed import SealedStore
from asia.data.sources.simulated.source import Simulated
from asia.data.sources.source import (
    Channels,
    DataSet,
    DataTable,
    FileName,
    SealedEntry,
    Source,
    SourceData,
    Subset,
    TestSummary,
)
from asia.errors import UserError

GROUP = "asia.sources"

SOURCES: Mapping[str, type[Source]] = {
    "benchmark": OfficialBenchmark,
    "nonlinear_benchmarks": OfficialBenchmark,
    "nanodrone": Nanodrone,
    "simulated": Simulated,
}
"""ASIA's own sources, by the text before the colon of `data.source`. The second is an older name of
the first."""


def data_source(table: DataTable, root: Path) -> Source:
    """The source of the training and the guard records, and of the test unless that is encrypted.

    Args:
        root: the folder of the problem file, absolute
    """
    if table.source is None:
        if (table.test or table.test_experiments) and table.sealed:
            named = "test" if table.test else "test_experiments"
            raise UserError(f"[data] has both {named} and sealed: keep one of them")
        return RecordFiles.from_table(table, root)
    if table.train or table.test or table.sealed:
        raise UserError("[data] has both source and file names: keep one of them")
    if table.reading != Wanted((), ()) or table.test_experiments:
        raise UserError(
            "[data] has a source and options for reading files (time, time_unit, columns, "
            "missing, experiment_column, test_experiments): leave these out"
        )
    return source_class(table.source).from_table(table, root)


def test_source(table: DataTable, data: Source, root: Path) -> Source | None:
    """The source of the test records, None without a test; the others are in `data`."""
    if table.sealed is not None:
        return SealedStore.from_table(table, root)
    return data if data.has_test else None


def source_class(text: str) -> type[Source]:
    """The class that `data.source` names, `name` or `name:argument`; ASIA's own or that of an
    installed package. Raises UserError."""
    name = text.partition(":")[0]
    if name in SOURCES:
        return SOURCES[name]
    plugged = {part.name: part for part in parts_of(GROUP)}
    if name not in plugged:
        forms = [*dict.fromkeys(s.usage or name for name, s in SOURCES.items()), *plugged]
        raise UserError(
            f"data.source is '{text}', expected {', '.join(map(repr, forms))}; files are named in "
            f"data.train and data.test{suggestion(name, [*SOURCES, *plugged])}"
        )
    part = plugged[name]
    return checked_class(part.load(), f"source '{name}' of package {part.package}")


def checked_class(found: object, what: str) -> type[Source]:
    """Return `found` when it is a class that can be a source.

    Args:
        what: its name in messages

    Raises:
        UserError: naming the missing parts
    """
    if not (isinstance(found, type) and issubclass(found, Source)):
        raise UserError(f"{what} is no class derived from asia.data.sources.Source")
    lacks = sorted(getattr(found, "__abstractmethods__", ()))
    if lacks:
        raise UserError(f"{what} lacks {', '.join(f'{name}()' for name in lacks)}: define it there")
    return found


__all__ = [
    "SOURCES",
    "Channels",
    "DataSet",
    "DataTable",
    "FileName",
    "SealedEntry",
    "Source",
    "SourceData",
    "Subset",
    "TestSummary",
    "checked_class",
    "data_source",
    "source_class",
    "test_source",
]
