"""Flights of the nanodrone benchmark (https://github.com/idsia-robotics/nanodrone-sysid-benchmark):
where its CSV files lie on this machine."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from asia.data.intake.conversion import as_written
from asia.data.intake.sheet import Wanted
from asia.data.intake.text import Text
from asia.data.sources.official import OfficialBenchmark, is_lfs_pointer
from asia.data.sources.source import Channels, DataSet, SourceData, Subset
from asia.errors import UserError

_REPOSITORY = "nanodrone-sysid-benchmark"
_ADDRESS = f"https://github.com/idsia-robotics/{_REPOSITORY}"
_FLIGHTS = {
    "train": tuple(
        f"{kind}_20251017_run{k}" for kind in ("chirp", "random", "square") for k in (1, 2, 3, 4)
    ),
    "test": tuple(f"melon_20251017_run{k}" for k in (1, 2, 3)),
}


@dataclass(frozen=True)
class Nanodrone(DataSet):
    """The flights, `data/<subset>/<flight>.csv` in a clone of the repository: in
    $ASIA_DATA_DIR/nanodrone, $ASIA_DATA_DIR/nanodrone-sysid-benchmark or
    ~/.asia/nanodrone-sysid-benchmark, the first that has them all."""

    source: str = "nanodrone"

    usage: ClassVar[str] = "nanodrone"
    public: ClassVar[bool] = True
    test_kept: ClassVar[str] = OfficialBenchmark.test_kept

    def __post_init__(self) -> None:
        if self.source != "nanodrone":
            raise UserError(f"data.source is '{self.source}': write 'nanodrone' alone")

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        inputs, outputs = channels.names
        wanted = Wanted(tuple(inputs), tuple(outputs))
        sheets = [Text().read(path, wanted)[0] for path in _flights(subset)]
        return SourceData(
            tuple(as_written(sheet, wanted, channels.sampling_time) for sheet in sheets)
        )

    def places(self, subset: Subset) -> tuple[Path, ...]:
        if subset == "guard":
            return tuple(path for path in _flights("train") if path.stem in self.guard)
        return _flights(subset)


def _flights(subset: Literal["train", "test"]) -> tuple[Path, ...]:
    """The files. Raises UserError that says how to get them."""
    missing = ""
    own, home = os.environ.get("ASIA_DATA_DIR"), Path.home() / ".asia" / _REPOSITORY
    for clone in [*([Path(own) / "nanodrone", Path(own) / _REPOSITORY] if own else []), home]:
        folder = clone / "data" / subset
        paths = tuple(folder / f"{name}.csv" for name in _FLIGHTS[subset])
        absent = [path for path in paths if not path.is_file()]
        if absent:
            if len(absent) < len(paths) and not missing:
                missing = f" ({absent[0]} is missing)"
            continue
        for path in paths:
            if is_lfs_pointer(path):
                raise UserError(
                    f"{path} is a pointer of git-lfs and not the flight itself, for {clone} was "
                    f"cloned without git-lfs: install git-lfs and run git lfs pull in {clone}, or "
                    f"unpack the archive of a release from {_ADDRESS}/releases there"
                )
        return paths
    raise UserError(
        f"the flights of the nanodrone benchmark are not on this machine{missing}: run "
        f"git clone {_ADDRESS} {home}, or clone it into a folder of yours and set "
        f"ASIA_DATA_DIR to that folder, so that "
        f"$ASIA_DATA_DIR/{_REPOSITORY}/data/{subset}/{_FLIGHTS[subset][0]}.csv exists"
    )
