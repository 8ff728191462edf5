"""Bags of ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from asia.data.intake.extras import need
from asia.data.intake.sheet import Column, FileFormat, Sheet, Wanted, find_column
from asia.errors import UserError


class Rosbag(FileFormat):
    """A channel is `/topic/field`, or `/topic/field/2` in an array. Its times are those of the
    messages' headers, where all have one, and of their receipt otherwise or with `--time
    receipt`."""

    name = "rosbag"
    suffixes: ClassVar[tuple[str, ...]] = (".bag", ".db3", ".mcap", "/")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        highlevel: Any = need("rosbags.highlevel", path, "ros")
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise UserError(f"{path} is a folder without a metadata.yaml: name a file or a bag")
        place = path.parent if path.suffix in (".db3", ".mcap") else path
        typesys: Any = need("rosbags.typesys", path, "ros")
        store: Any = typesys.get_typestore(typesys.Stores.LATEST)
        try:
            with highlevel.AnyReader([place], default_typestore=store) as reader:
                columns = _columns(reader, wanted)
        except (OSError, highlevel.AnyReaderError) as error:
            raise UserError(f"{path} does not read as a bag: {error}") from None
        return (Sheet(path.stem, columns, where=str(path)),)


def _columns(reader: Any, wanted: Wanted) -> dict[str, Column]:
    values: dict[str, list[float]] = {}
    stamps: dict[str, list[float]] = {}
    topics = [c for c in reader.connections if _is_asked(c.topic, wanted)]
    first = int(reader.start_time)
    for connection, received, raw in reader.messages(connections=topics or reader.connections):
        message = reader.deserialize(raw, connection.msgtype)
        when = received if wanted.time == "receipt" else _stamp(message, received)
        for name, value in _fields(message, connection.topic):
            values.setdefault(name, []).append(value)
            stamps.setdefault(name, []).append((when - first) * 1e-9)
    return {
        name: Column(np.array(found), "", np.round(np.array(stamps[name], dtype=np.float64), 9))
        for name, found in values.items()
    }


def _is_asked(topic: str, wanted: Wanted) -> bool:
    return any(name.startswith(topic) or find_column([topic], name) for name in wanted.names)


def _stamp(message: Any, received: int) -> int:
    header: Any = getattr(message, "header", None)
    if header is None:
        return received
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec) or received


def _fields(value: Any, name: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray | list) and len(value) <= 64:
        for k, one in enumerate(value):
            yield from _fields(one, f"{name}/{k}")
    else:
        for key in getattr(value, "__dataclass_fields__", {}):
            if key not in ("header", "__msgtype__"):
                yield from _fields(getattr(value, key), f"{name}/{key}")
