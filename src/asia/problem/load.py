"""Load problems: built-in by name, from a directory, from the lock of a run."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

from asia._files import read_text
from asia._text import suggestion
from asia.data.intake.sheet import Wanted
from asia.data.sources.files import RecordFiles
from asia.data.sources.registry import data_source, test_source
from asia.data.sources.source import Channels
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.problem.check import check_period
from asia.problem.lock import check_digests
from asia.problem.physics import check_physics
from asia.problem.problem import Problem, TestSource, prepared
from asia.problem.protocol import ProtocolRule, block_count, least_case
from asia.problem.protocol_table import check_protocol, with_groups
from asia.problem.schema import LockFile, ProblemFile, ProblemTables
from asia.problem.symmetry import check_symmetry
from asia.problem.toml import read_table

_FILE = "problem.toml"
LEAST_BEYOND_PAST = 10


@dataclass(frozen=True)
class _Texts:
    name: str
    description: str
    baseline: str | None
    notes: str = ""
    strategies: str = ""


def builtin_problems() -> tuple[str, ...]:
    """Names of the problems that come with ASIA."""
    return tuple(sorted(p.parent.name for p in _builtin_root().glob(f"*/{_FILE}")))


def load_problem(name_or_path: str | Path) -> Problem:
    """Load a built-in problem by name, a directory with problem.toml, or that file.

    The training records are read; the test records stay closed.

    Raises:
        UserError: with one sentence for each problem that the user can fix
    """
    path = _find(name_or_path)
    file = read_table(path, ProblemFile)
    texts = _Texts(
        name=file.name or path.resolve().parent.name,
        description=_description(path, file.description),
        baseline=_optional_text(path.parent / "baseline.py"),
        notes=_named_text(path, file.notes),
        strategies=_named_text(path, file.strategies),
    )
    return _assemble(file, path.resolve().parent, texts)


def load_lock(path: Path) -> Problem:
    """Load the problem of a run from its problem.lock.toml alone.

    The digest of the test data goes into the handle `test` and is verified when they are opened.

    Raises:
        UserError: for data that no longer have the digest recorded when the run began
    """
    file = read_table(path, LockFile)
    texts = _Texts(file.name, file.description, file.baseline, file.notes, file.strategies)
    problem = _assemble(file, path.resolve().parent, texts, file.digests.test, file.digests.guard)
    check_digests(problem, file.digests, path)
    return problem


def read_records(
    problem: Problem, path: Path, reading: Wanted | None = None
) -> tuple[Trajectory, ...]:
    """Read the records of a file that the user brings, with the columns and the sampling time of
    the problem, by the rules of a test.

    Args:
        reading: options of reading in place of those of the problem
    """
    data = problem.data if isinstance(problem.data, RecordFiles) else RecordFiles(())
    return prepared(problem, data.records_of(path, problem.channels, reading).records)


def _builtin_root() -> Path:
    return Path(str(resources.files("asia"))) / "problems"


def _find(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if (path / _FILE).is_file():
        return path / _FILE
    if path.is_file():
        return path
    builtin = _builtin_root() / str(name_or_path) / _FILE
    if str(name_or_path) in builtin_problems():
        return builtin
    if path.is_dir():
        raise UserError(f"{path} has no {_FILE}: make one with asia init")
    known = builtin_problems()
    raise UserError(
        f"no problem '{name_or_path}': expected a directory with {_FILE} or a built-in name "
        f"({', '.join(known)}){suggestion(str(name_or_path), known)}"
    )


def _optional_text(path: Path) -> str | None:
    there = os.path.lexists(path)
    return read_text(path, "put a file of text there, or nothing") if there else None


def _text(path: Path) -> str:
    return read_text(path, "problem.toml names it: put a file of text there, or leave it out")


def _description(path: Path, named: str | None) -> str:
    if named is None:
        return _optional_text(path.parent / "description.md") or ""
    return _text(path.parent / named)


def _named_text(path: Path, named: str | None) -> str:
    return "" if named is None else _text(path.parent / named)


def _assemble(
    file: ProblemTables,
    root: Path,
    texts: _Texts,
    test_sha256: str | None = None,
    guard_sha256: str | None = None,
) -> Problem:
    channels = Channels(file.inputs, file.outputs, file.sampling_time)
    _check_names(channels)
    physics = file.physics
    names = [s.name for s in channels.inputs], [s.name for s in channels.outputs]
    if physics is not None:
        check_physics(physics, *names)
    check_symmetry(file.symmetry, *names, physics)
    _check_preprocess(file, *names)
    check_protocol(file.protocol, file.data.groups, [s.name for s in channels.outputs])
    data = data_source(file.data, root)
    least = least_samples(file.protocol.rule()) * file.preprocess.decimate
    records = data.records("train", replace(channels, least=least))
    recorded = [t.name for t in records.trajectories]
    _require_records(recorded, file)
    rule = with_groups(file.protocol.rule(), file.data.groups, recorded)
    done = file.preprocess
    train = done.records(records.trajectories, channels.inputs, channels.outputs)
    require_length(train, rule)
    check_period(train, file.data.period)
    _require_motion(train, channels.outputs)
    return Problem(
        name=texts.name,
        description=texts.description,
        sampling_time=channels.sampling_time * done.decimate,
        inputs=done.signals(channels.inputs),
        outputs=done.signals(channels.outputs),
        train=train,
        data=data,
        test=TestSource(test_source(file.data, data, root), test_sha256),
        protocol=rule,
        budget=file.budget,
        physics=physics,
        baseline=texts.baseline,
        notes=texts.notes,
        strategies=texts.strategies,
        truth=None if done else records.truth,
        preprocess=done,
        recorded=channels if done else None,
        warnings=records.warnings,
        guard_sha256=guard_sha256,
        symmetry=file.symmetry,
        period=file.data.period,
    )


def _require_records(names: Sequence[str], file: ProblemTables) -> None:
    if not names:
        raise UserError(
            f"data.source '{file.data.source}' has no training records: name a folder that has them"
        )


def _check_preprocess(file: ProblemTables, inputs: list[str], outputs: list[str]) -> None:
    done = file.preprocess
    done.check(inputs, outputs)
    if file.physics is not None and (done.offset or done.scale):
        raise UserError(
            "preprocess.offset and preprocess.scale change the units in which [physics] is "
            "written: leave them out, or the equations"
        )
    if isinstance(file.data.guard, int) and done:
        raise UserError("[preprocess] is for measured records: leave it out for a simulated source")


def _check_names(channels: Channels) -> None:
    counts = Counter(s.name for s in (*channels.inputs, *channels.outputs))
    for name, count in counts.items():
        if count > 1:
            raise UserError(f"signal '{name}' is named {count} times among inputs and outputs")


def least_samples(rule: ProtocolRule) -> int:
    """The shortest training record that the folds can divide."""
    if rule.folds.kind == "leave_one_group_out":
        return rule.past + max(least_case(rule), LEAST_BEYOND_PAST)
    gap = rule.folds.gap or 0
    if rule.folds.tail is not None:
        shortest = rule.past + least_case(rule) + gap
        return rule.past + max(rule.folds.tail, rule.folds.count * least_case(rule)) + shortest
    beyond = max(least_case(rule), LEAST_BEYOND_PAST) + gap
    return rule.past + block_count(rule) * (rule.past + beyond)


def require_length(trajectories: Sequence[Trajectory], rule: ProtocolRule) -> None:
    """Raise UserError when a record is too short for the folds: each held-out block must be able to
    hold a past window and some samples to train on."""
    gap = rule.folds.gap or 0
    if rule.folds.kind == "leave_one_group_out":
        wanted = f"a past window of {rule.past}"
        advice = "a shorter past window"
    elif rule.folds.tail is not None:
        tail, count = rule.folds.tail, rule.folds.count
        wanted = f"a tail of {tail} in {count} folds with a past window of {rule.past}"
        advice = "fewer folds, a shorter tail or past window"
    else:
        wanted = f"{rule.folds.count} folds with a past window of {rule.past}"
        wanted += f" and a gap of {gap}" if gap else ""
        advice = "fewer folds, a shorter past window" + (" or gap" if gap else "")
    if rule.horizon is not None:
        wanted += f" and a horizon of {rule.horizon}"
        advice = f"{advice} or horizon"
    least = least_samples(rule)
    for t in trajectories:
        if len(t) < least:
            raise UserError(
                f"record '{t.name}' has {len(t)} samples, but {wanted} need at least {least}: "
                f"use {advice} or a longer record"
            )


def _require_motion(trajectories: Sequence[Trajectory], outputs: Sequence[Signal]) -> None:
    for index, signal in enumerate(outputs):
        value = float(trajectories[0].y[0, index])
        if all((t.y[:, index] == value).all() for t in trajectories):
            raise UserError(
                f"output '{signal.name}' is {value:g} in every training sample: there is nothing "
                "to identify; name another column or bring records in which it moves"
            )
