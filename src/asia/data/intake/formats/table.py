"""Table of file formats and the choice of the format for a file."""

from __future__ import annotations

from pathlib import Path

from asia.data.intake.formats.arrays import Hdf5, Matlab, NumpyFile
from asia.data.intake.formats.arrow import Arrow
from asia.data.intake.formats.excel import Excel
from asia.data.intake.formats.loggers import Mdf, Tdms
from asia.data.intake.formats.rosbag import Rosbag
from asia.data.intake.formats.text import Text
from asia.data.intake.sheet import FileFormat, Sheet, Wanted
from asia.errors import UserError

FORMATS: tuple[type[FileFormat], ...] = (
    Text, Matlab, Hdf5, Arrow, NumpyFile, Excel, Tdms, Mdf, Rosbag,
)  # fmt: skip


def file_format(path: Path) -> FileFormat:
    """The format of a file, by the end of its name. Raises UserError."""
    if not path.exists():
        raise UserError(f"no such file: {path}")
    suffix = "/" if path.is_dir() else path.suffix.lower()
    found = next((f for f in FORMATS if suffix in f.suffixes), None)
    if found is None:
        known = ", ".join(s for f in FORMATS for s in f.suffixes if s != "/")
        what = "a folder" if suffix == "/" else f"a file of the kind '{suffix}'"
        raise UserError(f"{path} is {what}, which ASIA does not read: expected one of {known}")
    return found()


def read_sheets(path: Path, wanted: Wanted) -> tuple[Sheet, ...]:
    """Read the tables in a file.

    Raises:
        UserError: when the file cannot be read
    """
    return file_format(path).read(path, wanted)
