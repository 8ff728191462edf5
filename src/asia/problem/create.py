"""New problem directories from files."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path

import numpy as np

from asia._files import read_file, sync_folder
from asia.data.intake.records import Intake, take_in
from asia.data.intake.sheet import Wanted
from asia.data.intake.text import Text
from asia.data.preprocess import Preprocess
from asia.data.relations import find_delay
from asia.data.store import PlainFile, key_folder
from asia.data.trajectory import (
    Array,
    Signal,
    Trajectory,
    check_magnitudes,
    check_ranges,
    unique_names,
)
from asia.errors import UserError
from asia.problem.load import least_samples, load_problem, require_length
from asia.problem.protocol import ProtocolRule
from asia.problem.sealing import STORE, Columns, Sealing, check_key_folder, remove_plain, seal_files
from asia.problem.toml import toml_value

# A record as the text of a CSV file.


_BLOCK = 65_536


@dataclass(frozen=True)
class RecordRows:
    """The text of a record that is too long to be held as a whole."""

    record: Trajectory
    """The record."""
    names: Sequence[str]
    """Names of inputs and outputs."""
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)
    """Callback for the progress of a long write, in words."""

    def blocks(self) -> Iterator[str]:
        """A header row with the names, then a row a sample. It reads back as the same numbers; an
        output that was not measured is `nan`."""
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(self.names)
        yield header.getvalue()
        u, y = self.record.u, self.record.measured_y
        for first in range(0, len(u), _BLOCK):
            part = slice(first, first + _BLOCK)
            if first:
                self.progress(f"writing {self.record.name}: {first / len(u):.0%} of {len(u)} rows")
            rows = zip(u[part].tolist(), y[part].tolist(), strict=True)
            # repr gives the shortest text that reads back as the same number.
            yield "".join(",".join(map(repr, [*a, *b])) + "\n" for a, b in rows)


def record_csv(record: Trajectory, names: Sequence[str]) -> str:
    """The whole text of `RecordRows`."""
    return "".join(RecordRows(record, names).blocks())


# A problem directory that is written whole or not at all.


def check_directory(directory: Path) -> None:
    """Raise UserError unless a new problem can be written there."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise UserError(f"{directory} is a file: choose another name for the problem")
    if any(directory.iterdir()):
        raise UserError(
            f"{directory} exists and is not empty: choose another name, nothing is overwritten"
        )


def write_directory(
    directory: Path,
    files: Sequence[tuple[str, str | RecordRows]],
    seal: Callable[[Path], Path] | None = None,
) -> Path | None:
    """Write `files`, names and texts, and load the problem, all or nothing.

    A temporary directory next to the final one is filled, loaded, then renamed.

    Args:
        seal: writes the store, and returns the path of its key

    Returns:
        the path of the key

    Raises:
        UserError: when the directory cannot be written or loaded
    """
    above = [p for p in directory.parents if not p.exists()]
    key: Path | None = None
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{directory.name}-", dir=directory.parent))
    except OSError as error:
        raise UserError(f"cannot write to {directory.parent}: {error.strerror}") from error
    try:
        for name, text in files:
            with (draft / name).open("w", encoding="utf-8") as file:
                file.writelines([text] if isinstance(text, str) else text.blocks())
        load_problem(draft)
        key = seal(draft) if seal else None
        draft.chmod(0o755)
        draft.rename(directory)
        sync_folder(directory.parent)
    except OSError as error:
        raise UserError(f"cannot write {directory}: {error.strerror}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if not directory.exists():
            if key is not None:
                key.unlink(missing_ok=True)
            for made in above:
                made.rmdir()
    return key


# The records of a new problem: files that stay as they are, or clean copies of them.


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


# Preprocessing of a new problem, derived from its training records.


@dataclass(frozen=True)
class Preparation:
    """Requested preprocessing."""

    delay: str | None = None
    """`auto`, or the samples by which all inputs are delayed."""
    decimate: int = 1
    """Every Nth sample is kept."""
    detrend: bool = False
    """The mean over the training records is taken off every signal."""
    scale: bool = False
    """Every signal is divided by its standard deviation over the training records."""


def prepare(
    wish: Preparation,
    records: Sequence[Trajectory],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Preprocess:
    """The numbers, from training records alone. Raises UserError."""
    if wish.decimate < 1:
        raise UserError(f"--decimate is {wish.decimate}: expected a whole number of at least 1")
    if wish == Preparation():
        return Preprocess()
    first = Preprocess(_delays(wish.delay, records, inputs), wish.decimate)
    signals = tuple(map(Signal, inputs)), tuple(map(Signal, outputs))
    records = [first.record(t, *signals) for t in records]
    values = dict(
        zip(
            (*inputs, *outputs),
            [*_columns([t.u for t in records]), *_columns([t.measured_y for t in records])],
            strict=True,
        )
    )
    # Six digits suffice and are readable.
    offset = {n: float(f"{np.nanmean(v):.6g}") for n, v in values.items()} if wish.detrend else {}
    spread = {n: float(f"{np.nanstd(v):.6g}") for n, v in values.items()} if wish.scale else {}
    return replace(first, offset=offset, scale={n: s for n, s in spread.items() if s > 0})


def preprocess_lines(done: Preprocess) -> str:
    """`[preprocess]` of problem.toml; "" where nothing is done."""
    if not done:
        return ""
    lines = ["", "[preprocess]                        # done to every record alike"]
    for name in ("delay", "decimate", "offset", "scale"):
        value = getattr(done, name)
        if value and value != 1:
            lines.append(f"{name} = {toml_value(value)}")
    return "\n".join(lines) + "\n"


def _columns(arrays: Sequence[Array]) -> list[Array]:
    return list(np.concatenate(arrays).T)


def _delays(
    wish: str | None, records: Sequence[Trajectory], inputs: Sequence[str]
) -> dict[str, int]:
    """Return the delays by input in samples; a model without delay responds at the sample after the
    input's."""
    if wish is None:
        return {}
    if wish != "auto":
        if not wish.isdecimal():
            raise UserError(f"--delay is {wish}: expected auto, or a whole number of samples")
        return {name: int(wish) for name in inputs if int(wish)}
    found: dict[str, int] = {}
    for k, name in enumerate(inputs):
        lags = [find_delay(records, k, c).lag for c in range(records[0].y.shape[1])]
        known = [lag for lag in lags if lag is not None]
        if known and min(known) > 1:
            found[name] = min(known) - 1
    return found


# A new problem directory from files of records.


_DESCRIPTION = """\
# {name}

Say in plain English what the system is: what the inputs do, what the outputs measure, which physics
you expect, what saturates, delays or sticks, how noisy the sensors are. Language-model agents read
this text, and the report prints it.
"""

_TOML = """\
name = {name}
description = "description.md"      # plain English: say what you know of the system
sampling_time = {sampling_time}                 # s
inputs  = {inputs}
outputs = {outputs}

[data]
{data}{preprocess}
[protocol]
folds = {{ kind = "contiguous", count = {folds} }}
past_inputs = {past_inputs}                    # samples a model sees before it simulates
past_outputs = {past_outputs}
metric = "rmse"                     # or "mae"

[budget]
experiments = 15
fit_seconds = 120                   # per fold

# [physics]                         # equations you trust, to be fitted and augmented
# states = ["x"]
# [physics.parameters]
# a = {{ min = 1e-3, max = 1.0 }}
# [physics.dynamics]                # d/dt
# x = "-a*x"
"""


@dataclass(frozen=True)
class NewProblem:
    """New problem directory.

    Attributes:
        path: path of problem.toml
        store: path of the encrypted test
        key: path of the key that opens it
        removed: plain files that were removed
        notes: further facts for the user, in plain words
    """

    path: Path
    store: Path | None = None
    key: Path | None = None
    removed: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    """Findings in the files and the changes made to them."""


@dataclass(frozen=True)
class _Plan:
    """Files to write: `files` by name inside the directory; `sealing` into its store."""

    train: tuple[str, ...]
    test: tuple[str, ...] = ()
    files: tuple[tuple[str, str | RecordRows], ...] = ()
    sealing: Sealing | None = None
    notes: tuple[str, ...] = ()
    comments: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    done: Preprocess = field(default_factory=Preprocess)
    time: str | None = None


def init_problem(
    directory: Path,
    *,
    train: Sequence[Path],
    test: Sequence[Path],
    inputs: Sequence[str],
    outputs: Sequence[str],
    sampling_time: float | None = None,
    test_experiments: Sequence[str] = (),
    seal_fraction: float | None = None,
    seal: bool = False,
    keys: Path | None = None,
    wanted: Wanted | None = None,
    preparation: Preparation | None = None,
) -> NewProblem:
    """Write problem.toml, with comments, and description.md.

    Files that need no change stay in place; clean copies of others are written into the directory
    as CSV, and problem.toml lists the changes. Everything is checked first, nothing is overwritten,
    and a failure leaves nothing behind.

    Args:
        sampling_time: s; None for that of the time stamps
        test_experiments: experiments in the training files that become the test
        wanted: options for reading the files, except the inputs and outputs
        preparation: settings for `[preprocess]`
        seal: move the test files into an encrypted store in the directory; they are removed
            last, after the store was read back
        keys: folder of the key, None for that of the user
        seal_fraction: share (0 to 0.5) at the end of each record to seal when there are no test
            files; the rest is written as CSV files into the directory

    Raises:
        UserError: for files or settings that make no problem
    """
    directory = directory.resolve()
    check_directory(directory)
    if seal_fraction is not None and not 0 < seal_fraction <= 0.5:
        raise UserError(
            f"the share to seal is {seal_fraction:g}, expected more than 0 and at most 0.5"
        )
    if not train:
        raise UserError("--train names no training data: name at least one file")
    for what, names in (("inputs", inputs), ("outputs", outputs)):
        if not names:
            raise UserError(f"--{what} is empty: name at least one column")
    if sampling_time is not None and not sampling_time > 0:
        raise UserError(f"sampling_time is {sampling_time}, expected a number above 0")
    rule = ProtocolRule()
    wanted = replace(wanted or Wanted((), ()), inputs=tuple(inputs), outputs=tuple(outputs))
    has_test = bool(test or test_experiments)
    split = seal_fraction is not None and not has_test
    least = _least(rule, seal_fraction if split else None)
    taken = take(train, test, wanted, sampling_time, least, test_experiments, split=split)
    if split:
        _check_split(taken.train, rule, least[0], seal_fraction or 0.0)
    inputs, outputs = taken.inputs, taken.outputs
    columns = Columns(inputs, outputs, taken.sampling_time)
    records = taken.train
    if seal_fraction is not None and not has_test:
        plan = _split_copies(train, columns, seal_fraction, taken)
        records = tuple(r[: len(r) - round(seal_fraction * len(r))] for r in records)
    else:
        make = _plan if taken.plain else _copied
        plan = make(train, test, columns, directory, taken, seal=seal and has_test)
    plan = replace(plan, time=wanted.time if taken.plain else None)
    done = prepare(preparation or Preparation(), records, inputs, outputs)
    tests = plan.sealing.records if plan.sealing else taken.test
    _check_test(tests, rule)
    check_magnitudes(records, inputs, outputs, "training")
    check_ranges(records, inputs, outputs)
    check_magnitudes(tests, inputs, outputs, "test")
    require_length(records, rule)
    files = (
        *plan.files,
        ("description.md", _DESCRIPTION.format(name=directory.name)),
        ("problem.toml", _text(directory.name, columns, rule, replace(plan, done=done))),
    )
    return _write(directory, files, plan, records, keys, _read_lines(taken, done))


def _write(
    directory: Path,
    files: Sequence[tuple[str, str | RecordRows]],
    plan: _Plan,
    records: Sequence[Trajectory],
    keys: Path | None,
    read: tuple[str, ...],
) -> NewProblem:
    sealing = plan.sealing
    if sealing is None:
        write_directory(directory, files)
        return NewProblem(directory / "problem.toml", notes=plan.notes, read=read)
    folder = key_folder(keys)
    check_key_folder(folder, directory)
    key = write_directory(directory, files, lambda draft: sealing.write(draft, records, folder))
    gone = remove_plain(sealing, directory / STORE, folder)
    notes = (*plan.notes, *gone.notes)
    return NewProblem(directory / "problem.toml", directory / STORE, key, gone.removed, notes, read)


def _least(rule: ProtocolRule, seal_fraction: float | None) -> tuple[int, int]:
    """Return the least samples of a segment of a training record, and of a test record."""
    train = least_samples(rule)
    if seal_fraction is not None:
        train = ceil(train / (1.0 - seal_fraction)) + 1
    return train, rule.past + 1


def _check_split(
    records: Sequence[Trajectory], rule: ProtocolRule, least: int, share: float
) -> None:
    """Raise UserError for a record too short to be divided into training and test."""
    for t in records:
        if len(t) < least:
            raise UserError(
                f"record '{t.name}' has {len(t)} samples, but {rule.folds.count} folds and a "
                f"sealed test of the last {share:.0%} need at least {least}: bring a longer "
                f"record, or use --no-seal, which needs {least_samples(rule)}"
            )


def _read_lines(taken: Taken, done: Preprocess) -> tuple[str, ...]:
    many = f"{len(taken.train)} training and {len(taken.test)} test records"
    prepared = [line for line in preprocess_lines(done).split("\n")[2:] if line]
    return (f"{many}, sampled every {taken.sampling_time:g} s", *taken.notes, *prepared)


def _text(name: str, columns: Columns, rule: ProtocolRule, plan: _Plan) -> str:
    return _TOML.format(
        name=toml_value(name),
        sampling_time=toml_value(float(columns.sampling_time)),
        inputs=_signals(columns.inputs, plan),
        outputs=_signals(columns.outputs, plan),
        data=_data_lines(plan),
        preprocess=preprocess_lines(plan.done),
        folds=rule.folds.count,
        past_inputs=rule.past_inputs,
        past_outputs=rule.past_outputs,
    )


def _signals(names: Sequence[str], plan: _Plan) -> str:
    return toml_value([{"name": name, "unit": plan.units.get(name, "")} for name in names])


def _check_test(records: Sequence[Trajectory], rule: ProtocolRule) -> None:
    for record in records:
        if len(record) <= rule.past:
            raise UserError(
                f"test record '{record.name}' has {len(record)} samples, the past window alone "
                f"takes {rule.past}: bring a longer record"
            )


def _plan(
    train: Sequence[Path],
    test: Sequence[Path],
    columns: Columns,
    directory: Path,
    taken: Taken,
    *,
    seal: bool,
) -> _Plan:
    """All records where they are, but for a test that is to be sealed."""
    del taken
    kept = tuple(_written(path, directory) for path in train)
    if seal:
        return _Plan(kept, sealing=seal_files(test, columns))
    return _Plan(kept, tuple(_written(path, directory) for path in test))


def _copied(
    train: Sequence[Path],
    test: Sequence[Path],
    columns: Columns,
    directory: Path,
    taken: Taken,
    *,
    seal: bool,
) -> _Plan:
    """Clean copies of all records, those of the test in the store where it is to be sealed."""
    del directory
    names = (*columns.inputs, *columns.outputs)
    files = tuple((f"{t.name}.csv", RecordRows(t, names, taken.progress)) for t in taken.train)
    tests = tuple((f"{t.name}.csv", RecordRows(t, names, taken.progress)) for t in taken.test)
    plan = _Plan(tuple(name for name, _ in files), comments=_comments(taken, (*train, *test)))
    plan = replace(plan, units=taken.units)
    if not seal:
        tested = tuple(name for name, _ in tests)
        return replace(plan, test=tested, files=(*files, *tests))
    contents = tuple(PlainFile(n, "".join(rows.blocks()).encode()) for n, rows in tests)
    return replace(
        plan,
        files=files,
        sealing=Sealing(columns, contents),
        notes=(_still_held(test or train),),
    )


def _split_copies(train: Sequence[Path], columns: Columns, share: float, taken: Taken) -> _Plan:
    """Clean copies, the last `share` of each record to seal."""
    names = (*columns.inputs, *columns.outputs)
    files: list[tuple[str, RecordRows]] = []
    sealed: list[PlainFile] = []
    for t in taken.train:
        keep = len(t) - round(share * len(t))
        files.append((f"{t.name}_train.csv", RecordRows(t[:keep], names, taken.progress)))
        text = record_csv(t[keep:], names)
        sealed.append(PlainFile(f"{t.name}_sealed.csv", text.encode()))
    return _Plan(
        tuple(name for name, _ in files),
        files=tuple(files),
        sealing=Sealing(columns, tuple(sealed)),
        notes=(_still_held(train),),
        comments=_comments(taken, train),
        units=taken.units,
    )


def _comments(taken: Taken, paths: Sequence[Path]) -> tuple[str, ...]:
    made = [f"made by asia init from {line}" for line in origins(paths)]
    return (*made, *taken.notes)


def _still_held(paths: Sequence[Path]) -> str:
    return (
        f"the test rows are also in {', '.join(map(str, paths))}, unencrypted. Do not show these "
        "rows to people or agents that build the models"
    )


def _written(path: Path, directory: Path) -> str:
    """Return a relative path when the data are in the problem's directory, so that both can move
    together."""
    path = path.resolve()
    if path.is_relative_to(directory.parent):
        return Path(os.path.relpath(path, directory)).as_posix()
    return str(path)


def _data_lines(plan: _Plan) -> str:
    done = "".join(f"# {_one_line(text)}\n" for text in plan.comments)
    lines = f"{done}train = {toml_value(plan.train)}\n"
    if plan.time is not None:
        lines += f"time = {toml_value(plan.time)}\n"
    if plan.sealing is not None:
        return lines + plan.sealing.toml()
    if plan.test:
        return lines + f"test = {toml_value(plan.test)}\n"
    return lines + '# test = ["run2.csv"]             # opened once, at the end\n'


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)
