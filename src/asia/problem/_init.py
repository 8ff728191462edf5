"""A new problem directory from CSV files."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.problem._csv import read_csv, split_csv
from asia.problem._loading import load_problem, require_length
from asia.problem._toml import toml_value
from asia.problem._types import ProtocolRule, Trajectory

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
class _Plan:
    """What to write: `files` by name inside the directory."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    files: tuple[tuple[str, str], ...]
    note: str


def init_problem(
    directory: Path,
    *,
    train: Sequence[Path],
    test: Sequence[Path],
    inputs: Sequence[str],
    outputs: Sequence[str],
    sampling_time: float,
    seal_fraction: float | None,
) -> Path:
    """Writes problem.toml, with comments, and description.md, and returns the path of the former.

    sampling_time in seconds. Without test files and with a seal_fraction (0 to 0.5) that share at
    the end of each record becomes the test: both parts are written as CSV files into the
    directory. Everything is checked first, nothing is overwritten, and a failure leaves nothing
    behind. Raises UserError.
    """
    directory = directory.resolve()
    _check_directory(directory)
    rule = ProtocolRule()
    records = _read(train, inputs, outputs, sampling_time)
    if test:
        _check_test(_read(test, inputs, outputs, sampling_time), rule)
    sealing = None if test else seal_fraction
    if sealing is not None:
        records = _sealed_split(records, sealing, rule)
    require_length(records, rule)
    plan = _plan(directory, train, test, [*inputs, *outputs], sealing)
    text = _TOML.format(
        name=toml_value(directory.name),
        sampling_time=toml_value(float(sampling_time)),
        inputs=toml_value([{"name": name, "unit": ""} for name in inputs]),
        outputs=toml_value([{"name": name, "unit": ""} for name in outputs]),
        data=_data_lines(plan),
        folds=rule.folds.count,
        past_inputs=rule.past_inputs,
        past_outputs=rule.past_outputs,
    )
    description = _DESCRIPTION.format(name=directory.name)
    files = (*plan.files, ("description.md", description), ("problem.toml", text))
    _write(directory, files)
    return directory / "problem.toml"


def _check_directory(directory: Path) -> None:
    if not directory.exists():
        return
    if not directory.is_dir():
        raise UserError(f"{directory} is a file: choose another name for the problem")
    if any(directory.iterdir()):
        raise UserError(
            f"{directory} exists and is not empty: choose another name, nothing is overwritten"
        )


def _read(
    paths: Sequence[Path], inputs: Sequence[str], outputs: Sequence[str], sampling_time: float
) -> list[Trajectory]:
    return [read_csv(path, inputs, outputs, sampling_time).trajectory for path in paths]


def _check_test(records: Sequence[Trajectory], rule: ProtocolRule) -> None:
    for record in records:
        if len(record) <= rule.past:
            raise UserError(
                f"test record '{record.name}' has {len(record)} samples, the past window alone "
                f"takes {rule.past}: bring a longer record"
            )


def _sealed_split(
    records: Sequence[Trajectory], share: float, rule: ProtocolRule
) -> list[Trajectory]:
    if not 0 < share <= 0.5:
        raise UserError(f"the share to seal is {share:g}, expected more than 0 and at most 0.5")
    parts = [(r, len(r) - round(share * len(r))) for r in records]
    _check_test([r[keep:] for r, keep in parts], rule)
    return [r[:keep] for r, keep in parts]


def _plan(
    directory: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    wanted: Sequence[str],
    share: float | None,
) -> _Plan:
    if share is None:
        paths = [_written(p, directory) for p in train], [_written(p, directory) for p in test]
        return _Plan(tuple(paths[0]), tuple(paths[1]), (), "")
    stems = [path.stem for path in train]
    if len(set(stems)) < len(stems):
        raise UserError("two training files have the same name: rename one to split them")
    kept = tuple(f"{stem}_train.csv" for stem in stems)
    sealed = tuple(f"{stem}_sealed.csv" for stem in stems)
    texts = [split_csv(path, wanted, share) for path in train]
    files = (
        *zip(kept, (first for first, _ in texts), strict=True),
        *zip(sealed, (last for _, last in texts), strict=True),
    )
    note = (
        f"# The last {share:.0%} of each record is sealed as the test set. The original files "
        "still hold it:\n# keep them out of reach of whoever builds the models.\n"
    )
    return _Plan(kept, sealed, files, note)


def _written(path: Path, directory: Path) -> str:
    """Relative when the data lie beside the problem, so that both can move together."""
    path = path.resolve()
    if path.is_relative_to(directory.parent):
        return Path(os.path.relpath(path, directory)).as_posix()
    return str(path)


def _data_lines(plan: _Plan) -> str:
    lines = plan.note + f"train = {toml_value(plan.train)}\n"
    if plan.test:
        return lines + f"test = {toml_value(plan.test)}\n"
    return lines + '# test = ["run2.csv"]             # opened once, at the end\n'


def _write(directory: Path, files: Sequence[tuple[str, str]]) -> None:
    """All or nothing: a directory beside the final one is filled, loaded, then renamed."""
    above = [p for p in directory.parents if not p.exists()]
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{directory.name}-", dir=directory.parent))
    except OSError as error:
        raise UserError(f"cannot write to {directory.parent}: {error.strerror}") from error
    try:
        for name, text in files:
            (draft / name).write_text(text, encoding="utf-8")
        load_problem(draft)
        draft.chmod(0o755)
        draft.rename(directory)
    except OSError as error:
        raise UserError(f"cannot write {directory}: {error.strerror}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if not directory.exists():
            for made in above:
                made.rmdir()
