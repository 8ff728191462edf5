"""Sheets out of named arrays in folders: MAT, HDF5 and NumPy files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from asia.data.intake.sheet import Cells, Column, FileTable, Wanted, find_channels

_STEPS = ("ts", "dt", "sampling_time", "sample_time", "samplingtime", "fs", "sampling_rate")
_RATES = ("fs", "sampling_rate")


def tree_sheets(
    name: str, where: str, tree: Mapping[str, Any], wanted: Wanted
) -> tuple[FileTable, ...]:
    """The folders of the tree that hold all wanted channels, one sheet each; the whole tree where
    none does.

    A matrix of n columns is n channels, called `name1` to `namen`; a channel is known by its own
    name, where that is the only one, and by its path.

    Args:
        tree: arrays, mappings and lists of mappings
    """
    found = list(_search(name, where, tree, wanted))
    return tuple(found) or (_sheet(name, where, tree),)


def _search(name: str, where: str, tree: Mapping[str, Any], wanted: Wanted) -> Iterator[FileTable]:
    sheet = _sheet(name, where, tree)
    if all(find_channels(sheet.columns, n) for n in wanted.names):
        yield sheet
        return
    for key, node in tree.items():
        if isinstance(node, Mapping):
            yield from _search(key, f"{where}, {key}", node, wanted)
        elif isinstance(node, list) and all(isinstance(n, Mapping) for n in node):
            for k, one in enumerate(node, 1):
                yield from _search(f"{key}{k}", f"{where}, {key}({k})", one, wanted)


def _sheet(name: str, where: str, tree: Mapping[str, Any]) -> FileTable:
    leaves = dict(_leaves(tree, ""))
    short = Counter(path.rpartition(".")[2] for path in leaves)
    columns: dict[str, Column] = {}
    step = None
    for path, values in leaves.items():
        bare = path.rpartition(".")[2]
        label = bare if short[bare] == 1 else path
        if values.size == 1:
            if bare.casefold() in _STEPS and values.dtype.kind in "fiu":
                value = float(values.flat[0])
                step = 1.0 / value if bare.casefold() in _RATES else value
            continue
        for key, cells in _split(label, values):
            columns[key] = Column(cells, matrix="" if key == label else label)
    lengths = Counter(len(c.cells) for c in columns.values())
    longest = max(lengths, key=lambda n: (lengths[n], n), default=0)
    kept = {k: c for k, c in columns.items() if len(c.cells) == longest}
    return FileTable(name, kept, step if step is not None and step > 0 else None, where)


def _leaves(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Cells]]:
    for key, node in tree.items():
        path = f"{prefix}{key}"
        if isinstance(node, Mapping):
            yield from _leaves(node, f"{path}.")
        elif isinstance(node, np.ndarray) and node.dtype.kind in "fiubMOUS" and node.ndim <= 3:
            yield path, np.asarray(node)
        elif isinstance(node, float | int | np.number):
            yield path, np.asarray(node, dtype=np.float64)


def _split(label: str, values: Cells) -> Sequence[tuple[str, Cells]]:
    """A matrix as its columns; time runs along the longer side."""
    values = np.squeeze(values)
    if values.dtype.kind in "US":
        values = values.astype(object)
    if values.ndim == 1:
        return [(label, values)]
    if values.ndim != 2:
        return []
    if values.shape[0] < values.shape[1]:
        values = values.T
    return [(f"{label}{k + 1}", values[:, k]) for k in range(values.shape[1])]
