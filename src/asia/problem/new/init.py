"""A new problem directory from CSV files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from asia.data._magnitudes import check_magnitudes, check_ranges
from asia.data._store import PlainFile, key_folder
from asia.data._trajectory import Trajectory
from asia.data.sources.csv import read_csv, split_csv
from asia.errors import UserError
from asia.problem._load import require_length
from asia.problem._toml import toml_value
from asia.problem.new.directory import check_directory, write_directory
from asia.problem.new.sealing import (
    STORE,
    Columns,
    Sealing,
    check_key_folder,
    remove_plain,
    seal_files,
)
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
{data}
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
    """What was made. path: of problem.toml; store: the encrypted test, key: what opens it; removed:
    plain files that are gone; notes: what else to know, in plain words."""

    path: Path
    store: Path | None = None
    key: Path | None = None
    removed: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Plan:
    """What to write: `files` by name inside the directory; `sealing` into its store."""

    train: tuple[str, ...]
    test: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    sealing: Sealing | None = None
    notes: tuple[str, ...] = ()


def init_problem(
    directory: Path,
    *,
    train: Sequence[Path],
    test: Sequence[Path],
    inputs: Sequence[str],
    outputs: Sequence[str],
    sampling_time: float,
    seal_fraction: float | None = None,
    seal: bool = False,
    keys: Path | None = None,
) -> NewProblem:
    """Writes problem.toml, with comments, and description.md.

    sampling_time in seconds. seal: the test files are moved into an encrypted store in the
    directory, its key into the folder `keys` (None: the person's own); they are removed last, once
    the store was read back. Without test files and with a seal_fraction (0 to 0.5) that share at
    the end of each record is sealed, and the rest written as CSV files into the directory.
    Everything is checked first, nothing is overwritten, and a failure leaves nothing behind. Raises
    UserError.
    """
    directory = directory.resolve()
    check_directory(directory)
    rule = ProtocolRule()
    columns = Columns(tuple(inputs), tuple(outputs), sampling_time)
    records = _read(train, columns)
    if test or seal_fraction is None:
        plan = _plan(train, test, columns, directory, seal=seal and bool(test))
    else:
        plan = _split(train, columns, seal_fraction)
        records = [r[: len(r) - round(seal_fraction * len(r))] for r in records]
    tests = plan.sealing.records if plan.sealing else _read(test, columns)
    _check_test(tests, rule)
    check_magnitudes(records, inputs, outputs, "training")
    check_ranges(records, inputs, outputs)
    check_magnitudes(tests, inputs, outputs, "test")
    require_length(records, rule)
    files = (
        *plan.files,
        ("description.md", _DESCRIPTION.format(name=directory.name)),
        ("problem.toml", _text(directory.name, columns, rule, plan)),
    )
    sealing = plan.sealing
    if sealing is None:
        write_directory(directory, files)
        return NewProblem(directory / "problem.toml")
    folder = key_folder(keys)
    check_key_folder(folder, directory)
    key = write_directory(directory, files, lambda draft: sealing.write(draft, records, folder))
    gone = remove_plain(sealing, directory / STORE, folder)
    notes = (*plan.notes, *gone.notes)
    return NewProblem(directory / "problem.toml", directory / STORE, key, gone.removed, notes)


def _text(name: str, columns: Columns, rule: ProtocolRule, plan: _Plan) -> str:
    return _TOML.format(
        name=toml_value(name),
        sampling_time=toml_value(float(columns.sampling_time)),
        inputs=toml_value([{"name": name, "unit": ""} for name in columns.inputs]),
        outputs=toml_value([{"name": name, "unit": ""} for name in columns.outputs]),
        data=_data_lines(plan),
        folds=rule.folds.count,
        past_inputs=rule.past_inputs,
        past_outputs=rule.past_outputs,
    )


def _read(paths: Sequence[Path], columns: Columns) -> list[Trajectory]:
    wanted = columns.inputs, columns.outputs, columns.sampling_time
    return [read_csv(path, *wanted).trajectory for path in paths]


def _check_test(records: Sequence[Trajectory], rule: ProtocolRule) -> None:
    for record in records:
        if len(record) <= rule.past:
            raise UserError(
                f"test record '{record.name}' has {len(record)} samples, the past window alone "
                f"takes {rule.past}: bring a longer record"
            )


def _plan(
    train: Sequence[Path], test: Sequence[Path], columns: Columns, directory: Path, *, seal: bool
) -> _Plan:
    """All records where they are, but for a test that is to be sealed."""
    kept = tuple(_written(path, directory) for path in train)
    if seal:
        return _Plan(kept, sealing=seal_files(test, train, columns))
    return _Plan(kept, tuple(_written(path, directory) for path in test))


def _split(train: Sequence[Path], columns: Columns, share: float) -> _Plan:
    """The last `share` of each record to seal, the rest to write."""
    if not 0 < share <= 0.5:
        raise UserError(f"the share to seal is {share:g}, expected more than 0 and at most 0.5")
    stems = [path.stem for path in train]
    if len(set(stems)) < len(stems):
        raise UserError("two training files have the same name: rename one to split them")
    kept = tuple(f"{stem}_train.csv" for stem in stems)
    texts = [split_csv(path, (*columns.inputs, *columns.outputs), share) for path in train]
    sealed = (
        PlainFile(f"{s}_sealed.csv", t[1].encode()) for s, t in zip(stems, texts, strict=True)
    )
    files = tuple((name, text[0]) for name, text in zip(kept, texts, strict=True))
    note = (
        f"the rows were copied out of {', '.join(map(str, train))}, which still hold them: keep "
        "these files out of reach of whoever builds the models"
    )
    return _Plan(kept, (), files, Sealing(columns, tuple(sealed)), (note,))


def _written(path: Path, directory: Path) -> str:
    """Relative when the data lie beside the problem, so that both can move together."""
    path = path.resolve()
    if path.is_relative_to(directory.parent):
        return Path(os.path.relpath(path, directory)).as_posix()
    return str(path)


def _data_lines(plan: _Plan) -> str:
    lines = f"train = {toml_value(plan.train)}\n"
    if plan.sealing is not None:
        return lines + plan.sealing.toml()
    if plan.test:
        return lines + f"test = {toml_value(plan.test)}\n"
    return lines + '# test = ["run2.csv"]             # opened once, at the end\n'
