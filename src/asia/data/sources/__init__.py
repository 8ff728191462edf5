"""Sources of records: one class a source, all derived from `Source`.

A source knows all records of a problem, in three subsets: `train`, `test` and `guard`. It reads
them, lists their files (which workers must not read), and writes itself as `[data]` of a problem
file. `SOURCES` has ASIA's own by name; an installed package adds one as an entry point of the group
`asia.sources`, and `data.source = "name:argument"` then names it. `asia.testing.check_source` is
the conformance suite of sources. Where training records are chosen by name, derive from `DataSet`.
"""

from asia.data.sources.registry import (
    SOURCES,
    checked_class,
    data_source,
    source_class,
    test_source,
)
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
