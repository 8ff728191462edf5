"""Data loggers: TDMS and MDF4. Channels may have times of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from asia.data.intake.extras import need
from asia.data.intake.sheet import Column, FileFormat, Sheet, Wanted, find_column
from asia.errors import UserError


class Tdms(FileFormat):
    """LabVIEW. Each group that has the wanted channels is a record."""

    name = "TDMS"
    suffixes: ClassVar[tuple[str, ...]] = (".tdms",)

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        nptdms = need("nptdms", path, "loggers")
        try:
            file: Any = nptdms.TdmsFile.read(path)
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path} does not read as TDMS: {error}") from None
        groups: list[Sheet] = []
        for group in file.groups():
            columns = {c.name: _tdms_column(c) for c in group.channels() if len(c)}
            where = f"{path}, group {group.name}"
            groups.append(Sheet(group.name, columns, where=where))
        full = [s for s in groups if all(find_column(list(s.columns), n) for n in wanted.names)]
        if len(full) > 1 and wanted.names:
            return tuple(full)
        every = {n: c for s in groups for n, c in s.columns.items()}
        return (Sheet(path.stem, full[0].columns if full else every, where=str(path)),)


def _tdms_column(channel: Any) -> Column:
    unit = str(channel.properties.get("unit_string", ""))
    timestamps = None
    if "wf_increment" in channel.properties:
        timestamps = np.asarray(channel.time_track(), dtype=np.float64)
    return Column(np.asarray(channel[:]), unit, timestamps)


class Mdf(FileFormat):
    """MDF 3 and 4 of automotive loggers. Groups have rasters of their own."""

    name = "MDF"
    suffixes: ClassVar[tuple[str, ...]] = (".mf4", ".mdf", ".dat4")

    def read(self, path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
        """Implement `FileFormat.read`."""
        asammdf = need("asammdf", path, "loggers")
        try:
            file: Any = asammdf.MDF(path)
        except (OSError, ValueError, asammdf.blocks.utils.MdfException) as error:
            raise UserError(f"{path} does not read as MDF: {error}") from None
        with file:
            known = [n for n in file.channels_db if n not in ("time", "t")]
            columns = {n: Column(np.zeros(0)) for n in known}
            for name in {find_column(known, n) for n in wanted.names} - {None}:
                place = file.channels_db[name]
                if len(place) > 1:
                    raise UserError(
                        f"{path}: {len(place)} channels are named '{name}': export the one that "
                        "you mean under a name of its own"
                    )
                signal = file.get(name, group=place[0][0], index=place[0][1])
                columns[name] = Column(
                    np.asarray(signal.samples),
                    str(signal.unit or ""),
                    np.asarray(signal.timestamps, dtype=np.float64),
                )
        return (Sheet(path.stem, columns, where=str(path)),)
