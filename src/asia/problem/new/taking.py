"""The records of a new problem: files that stay as they are, or clean copies of them."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from asia._files import read_file
from asia.data._trajectory import Trajectory, unique_names
from asia.data.intake.formats.text import Text
from asia.data.intake.records import Intake, take_in
from asia.data.intake.sheet import Wanted
from asia.errors import UserError

_HASHED = 64_000_000


@dataclass(frozen=True)
class Taken:
    """The records of a new problem."""

    train: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    inputs: tuple[str, ...]
    """Names, with the columns of a matrix in place of its name; likewise the outputs."""
    outputs: tuple[str, ...]
    sampling_time: float
    plain: bool
    """Whether the files can stay where they are, because they need no change."""
    units: Mapping[str, str]
    """Units by channel, where the files give them."""
    notes: tuple[str, ...]
    """Findings and changes."""
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)
    """Callback for the progress of a long write."""


def take(
    train: Sequence[Path],
    test: Sequence[Path],
    wanted: Wanted,
    sampling_time: float | None,
    least: tuple[int, int],
    test_experiments: Sequence[str] = (),
    *,
    split: bool = False,
) -> Taken:
    """Read the records.

    Args:
        least: least samples of a segment of a training record and of a test record
        test_experiments: experiments in the training files that are the test
        split: whether the last part of each record becomes the test

    Raises:
        UserError: for files that cannot be read as records
    """
    for path, count in Counter(p.resolve() for p in (*train, *test)).items():
        if count > 1:
            both = path in {p.resolve() for p in train} & {p.resolve() for p in test}
            what = "both train and test" if both else f"one list {count} times"
            raise UserError(f"{path} is named in {what}: name every record once")
    use = "split" if split else "train"
    found = take_in(train, wanted, use, sampling_time, least[0], without=test_experiments)
    step = found.records[0].sampling_time
    tests: list[Intake] = []
    if test:
        tests.append(take_in(test, wanted, "test", step, least[1]))
    if test_experiments:
        tests.append(take_in(train, wanted, "test", step, least[1], only=test_experiments))
    for one in tests:
        if (one.inputs, one.outputs) != (found.inputs, found.outputs):
            raise UserError(
                f"the test records have the channels {', '.join((*one.inputs, *one.outputs))}, the "
                f"training records {', '.join((*found.inputs, *found.outputs))}: name the columns "
                "one by one"
            )
    notes = tuple(dict.fromkeys(note for one in (found, *tests) for note in one.notes))
    records = _renamed([t for one in (found, *tests) for t in one.records])
    units = {name: unit for one in (*tests, found) for name, unit in one.units.items()}
    cut = len(found.records)
    is_text = all(path.suffix.lower() in Text.suffixes for path in (*train, *test))
    is_special = bool(wanted.experiment or wanted.columns or wanted.time_unit or test_experiments)
    plain = (
        is_text and not (notes or units or is_special) and len(records) == len(train) + len(test)
    )
    return Taken(
        records[:cut],
        records[cut:],
        found.inputs,
        found.outputs,
        step,
        plain,
        units,
        notes,
        wanted.progress,
    )


def origins(paths: Sequence[Path]) -> list[str]:
    """Describe the origin of clean copies, one line a file."""
    return [f"{path}{_hash(path)}" for path in paths]


def _hash(path: Path) -> str:
    if not path.is_file() or path.stat().st_size > _HASHED:
        return ""
    return f", sha256 {hashlib.sha256(read_file(path, 'name a file')).hexdigest()[:16]}"


def _renamed(records: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """Rename records so that their names are distinct file names."""
    bare = [re.sub(r"[^\w.+-]+", "_", t.name).strip("._") or "record" for t in records]
    names = unique_names(bare)
    return tuple(replace(t, name=n) for t, n in zip(records, names, strict=True))
