"""Flights of the nanodrone benchmark (https://github.com/idsia-robotics/nanodrone-sysid-benchmark):
where its CSV files lie on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from asia.errors import UserError

_REPOSITORY = "nanodrone-sysid-benchmark"
_ADDRESS = f"https://github.com/idsia-robotics/{_REPOSITORY}"
_FLIGHTS = {
    "train": tuple(
        f"{kind}_20251017_run{k}" for kind in ("chirp", "random", "square") for k in (1, 2, 3, 4)
    ),
    "test": tuple(f"melon_20251017_run{k}" for k in (1, 2, 3)),
}


def flight_paths(part: Literal["train", "test"]) -> tuple[Path, ...]:
    """The files of one part, `data/<part>/<flight>.csv` in a clone of the repository: in
    $ASIA_DATA_DIR/nanodrone, $ASIA_DATA_DIR/nanodrone-sysid-benchmark or
    ~/.asia/nanodrone-sysid-benchmark, the first that has them all.

    Raises UserError that says how to get them.
    """
    missing = ""
    for clone in _clones():
        folder = clone / "data" / part
        paths = tuple(folder / f"{name}.csv" for name in _FLIGHTS[part])
        absent = [path for path in paths if not path.is_file()]
        if not absent:
            return paths
        if len(absent) < len(paths) and not missing:
            missing = f" ({absent[0]} is missing)"
    raise UserError(
        f"the flights of the nanodrone benchmark are not on this machine{missing}: run "
        f"git clone {_ADDRESS} {_home()}, or clone it into a folder of yours and set "
        f"ASIA_DATA_DIR to that folder, so that "
        f"$ASIA_DATA_DIR/{_REPOSITORY}/data/{part}/{_FLIGHTS[part][0]}.csv exists"
    )


def _home() -> Path:
    return Path.home() / ".asia" / _REPOSITORY


def _clones() -> list[Path]:
    own = os.environ.get("ASIA_DATA_DIR")
    named = [Path(own) / "nanodrone", Path(own) / _REPOSITORY] if own else []
    return [*named, _home()]
