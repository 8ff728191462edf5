"""A new problem directory from files of records."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path

from asia.data._magnitudes import check_magnitudes, check_ranges
from asia.data._preprocess import Preprocess
from asia.data._store import PlainFile, key_folder
from asia.data._trajectory import Trajectory
from asia.data.intake.sheet import Wanted
from asia.errors import UserError
from asia.problem._load import least_samples, require_length
from asia.problem._toml import toml_value
from asia.problem.new.directory import check_directory, write_directory
from asia.problem.new.preparing import Preparation, prepare, preprocess_lines
from asia.problem.new.sealing import (
    STORE,
    Columns,
    Sealing,
    check_key_folder,
    remove_plain,
    seal_files,
)
from asia.problem.new.taking import Taken, origins, take
from asia.problem.new.text import RecordRows, record_csv
from asia.protocol._rules import ProtocolRule

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
