"""Conformance suite for sources of records."""

import os
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

from asia.data.sources.source import Channels, DataTable, SealedEntry, Source, SourceData, Subset
from asia.data.trajectory import data_digest


def check_source(
    make: Callable[[], Source], channels: Channels, *, harmless: Sequence[Path] = ()
) -> None:
    """Read all subsets of a source, the test too.

    Checked: a source made again is equal and reads the same; records fit `channels` and have names
    of their own; training records are not also test or guard records; `has_test` and `guard_names`
    say what is read; every file that is opened lies in `places`, but for `harmless` ones, which
    give nothing away (an encrypted store); `to_toml` makes an equal source. Only `places` protects
    the test from a candidate.
    """
    source = make()
    assert source == make(), "a source made again must be equal: derive a frozen dataclass"
    subsets: tuple[Subset, ...] = get_args(Subset)
    found = {subset: _read(source, subset, channels, harmless) for subset in subsets}
    for subset in subsets:
        records = found[subset]
        again = make().records(subset, channels)
        assert data_digest(again.trajectories) == data_digest(records.trajectories), (
            f"the {subset} records must be the same at every reading"
        )
        assert all(t.name for t in records.trajectories), f"a {subset} record has no name"
    assert bool(found["test"].trajectories) == source.has_test, "has_test must say what is read"
    names = tuple(t.name for t in found["guard"].trajectories)
    assert sorted(names) == sorted(source.guard_names), "guard_names must say what is read"
    digests = {data_digest([t]): t.name for t in found["train"].trajectories}
    for subset in ("test", "guard"):
        for t in found[subset].trajectories:
            same = digests.get(data_digest([t]))
            assert same is None, f"{subset} record '{t.name}' is also training record '{same}'"
    entries = {k: v for k, v in source.to_toml().items() if v is not None}
    table: dict[str, Any] = {k: tuple(v) if type(v) is list else v for k, v in entries.items()}
    if "sealed" in table:
        table["sealed"] = SealedEntry(**table["sealed"])
    again = type(source).from_table(DataTable(**table), Path("/"))
    assert again == source, f"from_table must make an equal source from to_toml, not {again}"


def _read(
    source: Source, subset: Subset, channels: Channels, harmless: Sequence[Path]
) -> SourceData:
    places = source.places(subset)
    for place in places:
        assert place.is_absolute(), f"{place} in places('{subset}') must be absolute"
    with _files_opened() as opened:
        found = source.records(subset, channels)
    # Guard records are chosen among those of a data set, and read with them.
    beside = source.places("train") if subset == "guard" else ()
    hidden = [place.resolve() for place in (*places, *beside, *harmless)]
    for path in dict.fromkeys(opened):
        real = Path(path).resolve()
        assert any(place == real or place in real.parents for place in hidden), (
            f"read('{subset}') opens {path}, which is in no place of places('{subset}'): "
            "candidates could read it"
        )
    return found


_watching: list[list[str]] = []


@contextmanager
def _files_opened() -> Generator[list[str]]:
    """Paths of the files opened meanwhile, those of Python and its packages left out."""
    if _note not in _hooked:
        sys.addaudithook(_note)
        _hooked.append(_note)
    opened: list[str] = []
    _watching.append(opened)
    try:
        yield opened
    finally:
        _watching.remove(opened)
        own = [Path(p).resolve() for p in (sys.prefix, sys.base_prefix, *sys.path) if p]
        own += [Path(p) for p in ("/proc", "/sys", "/dev", "/etc")]
        opened[:] = [
            p
            for p in opened
            if (real := Path(p).resolve()).suffix not in (".py", ".pyc")
            and not any(folder in real.parents for folder in own)
        ]


def _note(event: str, arguments: tuple[object, ...]) -> None:
    # An audit hook cannot be taken away again: without a watcher it does nothing.
    if event == "open" and _watching and isinstance(arguments[0], (str, bytes)):
        for opened in _watching:
            opened.append(os.path.abspath(os.fsdecode(arguments[0])))


_hooked: list[Callable[[str, tuple[object, ...]], None]] = []
