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
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from math import ceil
from pathlib import Path

import numpy as np

from asia._files import read_file, sync_folder
from asia.data.bad_samples import BadSamples, find_bad_samples
from asia.data.intake.conversion import Intake, take_in
from asia.data.intake.sheet import Wanted
from asia.data.intake.text import Text
from asia.data.preprocess import Preparation, Preprocess
from asia.data.statistics import delays
from asia.data.store import PlainFile, key_folder
from asia.data.trajectory import (
    Trajectory,
    check_magnitudes,
    check_ranges,
    unique_names,
)
from asia.errors import UserError
from asia.problem.folds import least_samples, require_length
from asia.problem.load import load_problem
from asia.problem.metrics import listed_metrics
from asia.problem.problem import DESCRIPTION_TEMPLATE, Problem
from asia.problem.protocol import ProtocolRule
from asia.problem.sealing import STORE, Columns, Sealing, check_key_folder, remove_plain, seal_files
from asia.problem.toml import toml_value

# A record as the text of a CSV file.


_BLOCK = 65_536


@dataclass(frozen=True)
class RecordRows:
    """The text of a record that is too long to be held as a whole."""

    record: Trajectory
    names: Sequence[str]
    """Names of inputs and outputs, and of the references where these are written too."""
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)
    """Callback for the progress of a long write, in words."""

    def blocks(self) -> Iterator[str]:
        """A header row with the names, then a row a sample. It reads back as the same numbers; an
        output that was not measured is `nan`."""
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(self.names)
        yield header.getvalue()
        u, y, r = self.record.u, self.record.measured_y, self.record.reference
        if r is not None and len(self.names) > u.shape[1] + y.shape[1]:
            y = np.hstack([y, r])
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
            f"{directory} exists and is not empty, nothing is overwritten: remove it, or choose "
            "another name"
        )


def write_directory(
    directory: Path,
    files: Mapping[str, str | bytes | RecordRows],
    seal: Callable[[Path], Path] | None = None,
) -> Path | None:
    """Write `files`, texts by name, and load the problem, all or nothing.

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
        for name, text in files.items():
            if isinstance(text, bytes):
                (draft / name).write_bytes(text)
                continue
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


def save_problem(directory: Path, files: Mapping[str, str | bytes]) -> Problem:
    """Write the problem directory, or verify that it holds the same files, and load it.

    Raises:
        UserError: for other files in the directory, with nothing overwritten, and for files that
            make no problem
    """
    if (directory / "problem.toml").is_file():
        for name, text in files.items():
            path = directory / name
            content = text.encode() if isinstance(text, str) else text
            if not path.is_file() or path.read_bytes() != content:
                raise UserError(
                    f"{directory} holds another problem ({name} differs), and nothing is "
                    "overwritten: name another directory, or remove this one"
                )
    else:
        check_directory(directory)
        write_directory(directory, files)
    return load_problem(directory)


# The records of a new problem: files that stay as they are, or clean copies of them.


@dataclass(frozen=True)
class _Records:
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
    notes: tuple[str, ...]
    readings: tuple[str, ...] = ()
    """Sampling time of each file, and the evidence for it."""
    references: tuple[str, ...] = ()
    """References of the training records."""


def _read_records(
    train: Sequence[Path],
    test: Sequence[Path],
    wanted: Wanted,
    sampling_time: float | None,
    least: tuple[int, int],
    test_experiments: Sequence[str],
    references: Sequence[str] = (),
    *,
    split: bool,
) -> _Records:
    """Read the records.

    Args:
        least: least samples of a segment of a training record and of a test record
        test_experiments: experiments in the training files that are the test
        references: further columns of the training files
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
    every = replace(wanted, inputs=(*wanted.inputs, *references))
    found = take_in(train, every, use, sampling_time, least[0], without=test_experiments)
    if references:
        nu = len(found.inputs) - len(references)
        kept = tuple(replace(t, u=t.u[:, :nu], reference=t.u[:, nu:]) for t in found.records)
        found, references = (
            replace(found, inputs=found.inputs[:nu], records=kept), found.inputs[nu:],
        )  # fmt: skip
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
    readings = tuple(dict.fromkeys(text for one in (found, *tests) for text in one.readings))
    units = {name: unit for one in (*tests, found) for name, unit in one.units.items()}
    # The names become distinct file names.
    every = [t for one in (found, *tests) for t in one.records]
    bare = [re.sub(r"[^\w.+-]+", "_", t.name).strip("._") or "record" for t in every]
    records = [replace(t, name=n) for t, n in zip(every, unique_names(bare), strict=True)]
    is_text = all(path.suffix.lower() in Text.suffixes for path in (*train, *test))
    is_special = bool(
        wanted.experiment
        or wanted.columns
        or wanted.time_unit
        or wanted.missing
        or test_experiments
    )
    is_whole = len(records) == len(train) + len(test)
    return _Records(
        train=tuple(records[: len(found.records)]),
        test=tuple(records[len(found.records) :]),
        inputs=found.inputs,
        outputs=found.outputs,
        sampling_time=step,
        plain=is_text and is_whole and not (notes or units or is_special),
        units=units,
        notes=notes,
        readings=readings,
        references=tuple(references),
    )


# Preprocessing of a new problem, derived from its training records.


def _prepare(
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
    delay: dict[str, int] = {}
    if wish.delay == "auto":
        for k, name in enumerate(inputs):
            column = [row[k] for row in delays(records)]
            known = [d.lag for d in column if d is not None and d.lag is not None]
            # A model without delay responds at the sample after the input's.
            if known and min(known) > 1:
                delay[name] = min(known) - 1
    elif wish.delay is not None:
        if not wish.delay.isdecimal():
            raise UserError(f"--delay is {wish.delay}: expected auto, or a whole number of samples")
        delay = {name: int(wish.delay) for name in inputs if int(wish.delay)}
    return Preprocess(delay, wish.decimate, wish.detrend, wish.scale)


# A new problem directory from files of records.


_TOML = """\
name = {name}
description = "description.md"      # plain English: say what you know of the system
sampling_time = {sampling_time}                 # s
# An input that nobody sets, such as the weather, has role = "disturbance".
inputs  = {inputs}
outputs = {outputs}

[data]
{data}

[protocol]
folds = {{ kind = "contiguous", count = {folds} }}
past_inputs = {past_inputs}                    # samples a model sees before it simulates
past_outputs = {past_outputs}
metric = "rmse"                     # or {metrics}

[budget]
experiments = 15
fit_seconds = 120                   # per fold

{loop}
# [plant]                           # your own simulator, to calibrate; outputs y (samples, outputs)
# source = "plant.py:simulate"      # def simulate(u, params, x0, dt): return y; or "model.fmu"
# [plant.parameters]
# k = {{ min = 0.01, max = 1.0 }}
# [plant.initial]                   # optional: initial states, estimated for each record
# h = {{ min = 0.0, max = 10.0 }}

# [physics]                         # equations you trust, to be fitted and augmented
# states = ["x"]
# [physics.parameters]
# a = {{ min = 1e-3, max = 1.0 }}
# [physics.dynamics]                # d/dt
# x = "-a*x"
"""


_LOOP = """\
# [loop]                            # {remark}
# reference = {names}{pad}# the measured reference: no input
# enters = "controller"             # u = C (r - y); "plant": u = r - C y
# inputs = "measured"               # "explained": for stable plants, opens all families
# Add the controller if you know it, in descending powers of z:
#     controller = {{ numerator = [..], denominator = [..] }}
"""


def _loop_example(references: Sequence[str]) -> str:
    """[loop] as a comment, with the columns that look like references."""
    names = toml_value(references[0] if len(references) == 1 else list(references) or "r")
    remark = "for records from a closed loop"
    if references:
        remark = "a closed loop, to judge by its columns: if so, remove these #"
    return _LOOP.format(remark=remark, names=names, pad=" " * max(1, 22 - len(names)))


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
    bad: tuple[BadSamples, ...] = ()
    """Bad samples of the training records and of the test inputs."""


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
    references: Sequence[str] = (),
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
        references: columns of the training files to keep, and to name in a comment on `[loop]`
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

    # The records.
    rule = ProtocolRule()
    wanted = replace(wanted or Wanted((), ()), inputs=tuple(inputs), outputs=tuple(outputs))
    has_test = bool(test or test_experiments)
    share = None if has_test else seal_fraction
    least = least_samples(rule)
    if share is not None:
        least = ceil(least / (1.0 - share)) + 1
    taken = _read_records(
        train,
        test,
        wanted,
        sampling_time,
        (least, rule.past + 1),
        test_experiments,
        references,
        split=share is not None,
    )
    for t in taken.train if share is not None else ():
        if len(t) < least:
            raise UserError(
                f"record '{t.name}' has {len(t)} samples, but {rule.folds.count} folds and a "
                f"sealed test of the last {share:.0%} need at least {least}: bring a longer "
                f"record, or use --no-seal, which needs {least_samples(rule)}"
            )
    inputs, outputs = taken.inputs, taken.outputs
    columns = Columns(inputs, outputs, taken.sampling_time)

    def copies(
        records: Sequence[Trajectory], ending: str = "", more: Sequence[str] = ()
    ) -> dict[str, RecordRows]:
        names = (*inputs, *outputs, *more)
        return {f"{t.name}{ending}.csv": RecordRows(t, names, wanted.progress) for t in records}

    # The files: the user's own or clean copies, and what goes into the store.
    records, tests = taken.train, taken.test
    files: dict[str, str | RecordRows] = {}
    sealing: Sealing | None = None
    if share is None and taken.plain:
        train_files = [_relative(path, directory) for path in train]
        test_files = [_relative(path, directory) for path in test]
        if seal and test:
            sealing = seal_files(test, columns)
    else:
        endings = ("", "")
        if share is not None:
            kept = [len(t) - round(share * len(t)) for t in taken.train]
            records = tuple(t[:n] for t, n in zip(taken.train, kept, strict=True))
            tests = tuple(t[n:] for t, n in zip(taken.train, kept, strict=True))
            endings = ("_train", "_sealed")
        train_copies = copies(records, endings[0], taken.references)
        test_copies = copies(tests, endings[1])
        train_files, test_files = list(train_copies), list(test_copies)
        files |= train_copies
        if share is not None or (seal and has_test):
            contents = [PlainFile(n, "".join(r.blocks()).encode()) for n, r in test_copies.items()]
            sealing = Sealing(columns, tuple(contents))
        else:
            files |= test_copies
    done = _prepare(preparation or Preparation(), records, inputs, outputs)
    tests = sealing.records if sealing else tests
    for t in tests:
        if len(t) <= rule.past:
            raise UserError(
                f"test record '{t.name}' has {len(t)} samples, the past window alone takes "
                f"{rule.past}: bring a longer record"
            )
    check_magnitudes(records, inputs, outputs, "training")
    check_ranges(records, inputs, outputs)
    check_magnitudes(tests, inputs, outputs, "test")
    require_length(records, rule)

    # problem.toml.
    data: list[str] = []
    if files:
        origins = [f"made by asia init from {_origin(path)}" for path in (*train, *test)]
        comments = [*origins, *taken.notes]
        data = [f"# {''.join(c if c.isprintable() else ' ' for c in line)}" for line in comments]
        data.append(f"readings = {toml_value(list(taken.readings))}")
    data.append(f"train = {toml_value(train_files)}")
    if not files and wanted.time is not None:
        data.append(f"time = {toml_value(wanted.time)}")
    if wanted.missing:
        entries = [asdict(entry) for entry in wanted.missing]
        data.append(f"missing = {toml_value(entries)}")
    if sealing is not None:
        data.append(sealing.toml().rstrip("\n"))
    elif test_files:
        data.append(f"test = {toml_value(test_files)}")
    else:
        data.append('# test = ["run2.csv"]             # opened once, at the end')
    names = ("delay", "decimate", "detrend", "scale")
    asked = [(n, getattr(done, n)) for n in names if getattr(done, n) != getattr(Preprocess(), n)]
    preprocess = [f"{name} = {toml_value(value)}" for name, value in asked]
    if done:
        data += [
            "",
            "[preprocess]                        # to every record; statistics by fold",
            *preprocess,
        ]
    signals = [
        toml_value([{"name": n, "unit": taken.units.get(n, "")} for n in names])
        for names in (inputs, outputs)
    ]
    files["description.md"] = DESCRIPTION_TEMPLATE.format(name=directory.name)
    files["problem.toml"] = _TOML.format(
        name=toml_value(directory.name),
        sampling_time=toml_value(float(taken.sampling_time)),
        inputs=signals[0],
        outputs=signals[1],
        data="\n".join(data),
        loop=_loop_example(taken.references),
        folds=rule.folds.count,
        past_inputs=rule.past_inputs,
        past_outputs=rule.past_outputs,
        metrics=listed_metrics(but="rmse"),
    )
    many = f"{len(taken.train)} training and {len(taken.test)} test records"
    summary = f"{many}, sampled every {taken.sampling_time:g} s"
    read = (summary, *taken.readings, *taken.notes, *preprocess)
    # Nothing of the outputs of a test is told.
    bad = (
        *find_bad_samples(records, inputs, outputs),
        *find_bad_samples(tests, inputs, outputs, only_inputs=True),
    )

    if sealing is None:
        write_directory(directory, files)
        return NewProblem(directory / "problem.toml", read=read, bad=bad)
    folder = key_folder(keys)
    check_key_folder(folder, directory)
    key = write_directory(directory, files, partial(sealing.write, train=records, keys=folder))
    removed, notes = remove_plain(sealing, directory / STORE, folder)
    if not sealing.originals:
        held = ", ".join(map(str, test or train))
        notes = (
            f"the test rows are also in {held}, unencrypted. Do not show these rows to people or "
            "agents that build the models",
            *notes,
        )
    return NewProblem(directory / "problem.toml", directory / STORE, key, removed, notes, read, bad)


def _origin(path: Path) -> str:
    """The path of a file, with the digest of its content unless that is long."""
    if not path.is_file() or path.stat().st_size > 64_000_000:
        return str(path)
    content = read_file(path, "name a file")
    return f"{path}, sha256 {hashlib.sha256(content).hexdigest()[:16]}"


def _relative(path: Path, directory: Path) -> str:
    """Return a relative path when the data are in the problem's directory, so that both can move
    together."""
    path = path.resolve()
    if path.is_relative_to(directory.parent):
        return Path(os.path.relpath(path, directory)).as_posix()
    return str(path)
