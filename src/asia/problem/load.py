"""Load problems: built-in by name, from a directory, from the lock of a run."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from asia._files import PACKAGE, read_file, read_text
from asia._text import suggestion
from asia.data.intake.frequency import read_frequency_response
from asia.data.intake.sheet import Wanted
from asia.data.sources import data_source, test_source
from asia.data.sources.files import RecordFiles
from asia.data.sources.source import Channels
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.problem.check import check_period
from asia.problem.control import check_control, control_problem
from asia.problem.feedback import explained_inputs
from asia.problem.folds import least_samples, require_length
from asia.problem.held_back import divided
from asia.problem.lock import check_digests
from asia.problem.memory import expanded
from asia.problem.physics import check_physics
from asia.problem.plant import load_plant
from asia.problem.problem import Problem, TestSource, prepared
from asia.problem.protocol_table import check_protocol, with_groups
from asia.problem.schema import LockFile, ProblemFile, ProblemTables
from asia.problem.symmetry import check_symmetry
from asia.problem.toml import read_table

_FILE = "problem.toml"
_IRREGULAR = '''"""First model of irregular samples: the given equations, fitted."""

from asia.models import {family}
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = {family}.build({family}.Config(), context)
    return {family}.train(model, trajectories, context, LevenbergMarquardt(30, starts=4))
'''
_BUILTIN = PACKAGE / "problems"


def builtin_problems() -> tuple[str, ...]:
    """Names of the problems that come with ASIA."""
    return tuple(sorted(p.parent.name for p in _BUILTIN.glob(f"*/{_FILE}")))


def load_problem(name_or_path: str | Path, guard_share: float | None = None) -> Problem:
    """Load a built-in problem by name, a directory with problem.toml, or that file.

    The training records are read; the test records stay closed.

    Args:
        guard_share: share of the training records to hold back as guard records, where the problem
            names none. A simulated source makes a fresh record instead, a control problem draws
            this share of its training scenarios in addition.

    Raises:
        UserError: with one sentence for each problem that the user can fix
    """
    path = _find(name_or_path)
    file = read_table(path, ProblemFile)
    if guard_share is not None and file.control is not None:
        scenarios = file.control.scenarios
        drawn = scenarios.guard or max(1, round(guard_share * scenarios.train))
        control = replace(file.control, scenarios=replace(scenarios, guard=drawn))
        file = replace(file, control=control)
    elif guard_share is not None and not file.data.guard and file.data.guard_share is None:
        simulated = (file.data.source or "").startswith("simulated:")
        given = {"guard": 1} if simulated else {"guard_share": guard_share}
        file = replace(file, data=replace(file.data, **given))

    def text(named: str | None, default: str) -> str | None:
        if named is not None:
            remedy = "problem.toml names it: put a file of text there, or leave it out"
            return read_text(path.parent / named, remedy)
        if default and os.path.lexists(path.parent / default):
            return read_text(path.parent / default, "put a file of text there, or nothing")
        return None

    description = text(file.description, "description.md") or ""
    baseline = text(None, "baseline.py")
    notes, strategies = text(file.notes, "") or "", text(file.strategies, "") or ""
    root = path.resolve().parent
    found = _assemble(file, root)
    if baseline is None and found.channels.time_step is not None:
        baseline = _IRREGULAR.format(family="greybox" if found.physics else "simulator")
    return replace(
        found,
        name=file.name or root.name,
        description=description,
        baseline=baseline,
        notes=notes,
        strategies=strategies,
    )


def load_lock(path: Path) -> Problem:
    """Load the problem of a run from its problem.lock.toml alone.

    The digest of the test data goes into the handle `test` and is verified when they are opened.

    Raises:
        UserError: for data that no longer have the digest recorded when the run began
    """
    file = read_table(path, LockFile)
    found = _assemble(file, path.resolve().parent)
    problem = replace(
        found,
        name=file.name,
        description=file.description,
        baseline=file.baseline,
        notes=file.notes,
        strategies=file.strategies,
        test=replace(found.test, sha256=file.digests.test),
        guard_sha256=file.digests.guard,
    )
    check_digests(problem, file.digests, path)
    return with_models(problem, path.parent, file.digests.models)


def with_models(problem: Problem, directory: Path, digests: Sequence[str] | None = None) -> Problem:
    """Return a control problem with the identified models of a run.

    Args:
        directory: run directory.
        digests: sha256 of the models; None for those of the lock.

    Raises:
        UserError: for a model that was changed.
    """
    if problem.control is None:
        return problem
    if digests is None:
        digests = read_table(directory / "problem.lock.toml", LockFile).digests.models
    models: list[bytes] = []
    for digest in digests:
        path = directory / "artifacts" / digest
        if not path.is_file():  # a ledger that was published without artifacts
            return problem
        models.append(read_file(path, "put it back"))
        if hashlib.sha256(models[-1]).hexdigest() != digest:
            raise UserError(f"artifact {path} was changed after it was written")
    return replace(problem, control=replace(problem.control, models=tuple(models)))


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


def _find(name_or_path: str | Path) -> Path:
    path, name, known = Path(name_or_path), str(name_or_path), builtin_problems()
    if (path / _FILE).is_file():
        return path / _FILE
    if path.is_file():
        return path
    if name in known:
        return _BUILTIN / name / _FILE
    if path.is_dir():
        raise UserError(f"{path} has no {_FILE}: make one with asia init")
    raise UserError(
        f"no problem '{name_or_path}': expected a directory with {_FILE} or a built-in name "
        f"({', '.join(known)}){suggestion(name, known)}"
    )


def _check_irregular(file: ProblemTables) -> None:
    """Raise UserError for tables that need one sampling time."""
    if [s.role for s in file.inputs].count("time_step") > 1:
        raise UserError("role = 'time_step' is given twice: keep one such input")
    if file.physics is None and file.plant is None:
        raise UserError(
            "role = 'time_step' keeps irregular samples, which only equations in [physics] or a "
            "simulator in [plant] can be integrated to: add one, or leave this input out to have "
            "the records resampled"
        )
    for table, given in (("[preprocess]", file.preprocess), ("[loop]", file.loop)):
        if given:
            raise UserError(f"{table} needs one sampling time: leave it out with irregular samples")


def _assemble(file: ProblemTables, root: Path) -> Problem:
    """Check the tables against each other and read the training records; the texts are left out.

    Args:
        root: folder of the file, absolute
    """
    channels = Channels(file.inputs, file.outputs, file.sampling_time)
    inputs, outputs = channels.names
    loop, reference = file.loop, tuple[Signal, ...]()
    if loop is not None:
        loop.check(len(inputs), len(outputs))
        reference = loop.reference
    for name, count in Counter((*inputs, *outputs, *(s.name for s in reference))).items():
        if count > 1:
            raise UserError(
                f"signal '{name}' is named {count} times among inputs, outputs and references"
            )
    if any(s.role for s in file.outputs) or all(s.role for s in file.inputs):
        raise UserError("a role belongs to an input, and at least one input must have none")
    if any(s.intersample for s in file.outputs):
        raise UserError("intersample belongs to an input: leave it out of the outputs")
    if channels.time_step is not None and any(s.intersample == "band_limited" for s in file.inputs):
        raise UserError(
            'intersample = "band_limited" needs one sampling time: give "first" or "zero" with '
            "irregular samples"
        )
    if channels.time_step is not None:
        _check_irregular(file)
    physics, done, rule = file.physics, file.preprocess, file.protocol.rule()
    if loop is not None and done:
        raise UserError("[preprocess] changes the signals of the [loop]: leave one of them out")
    if physics is not None:
        check_physics(physics, inputs, outputs)
        expanded(physics, outputs)
    check_symmetry(file.symmetry, inputs, outputs, physics)
    done.check(inputs)
    if file.control is not None:
        check_control(file.control, inputs, outputs)
    driven = [*inputs, *(file.control.disturbances if file.control else ())]
    plant = file.plant and load_plant(
        file.plant, root, driven, outputs, calibrated=file.control is None
    )
    if (rule.kind == "control") != (file.control is not None) or (file.control and not plant):
        raise UserError(
            'protocol.kind = "control", [control] and [plant] belong together: give all three, or '
            "leave out the first two"
        )
    if (physics or plant) and (done.detrend or done.scale):
        written = "[physics] is" if physics else "[plant] is"
        raise UserError(
            f"preprocess.detrend and preprocess.scale change the signals that {written} written "
            f"in: leave them out, or the {'equations' if physics else 'simulator'}"
        )
    if isinstance(file.data.guard, int) and done:
        raise UserError("[preprocess] is for measured records: leave it out for a simulated source")
    check_protocol(file.protocol, file.data.groups, outputs)
    data = data_source(file.data, root)
    least = least_samples(rule) * done.decimate
    columns = replace(channels, inputs=(*file.inputs, *reference), least=least)
    records = data.records("train", columns)
    if not records.trajectories:
        raise UserError(
            f"data.source '{file.data.source}' has no training records: name a folder that has them"
        )
    rule = with_groups(rule, file.data.groups, [t.name for t in records.trajectories])
    measured, truth = records.trajectories, records.truth
    if reference:
        nu = len(inputs)
        measured = tuple(replace(t, u=t.u[:, :nu], reference=t.u[:, nu:]) for t in measured)
    if loop is not None and loop.inputs == "explained":
        # Kept as they were measured: test and guard records, which have no reference.
        explained = explained_inputs(measured)
        measured = tuple(replace(t, u=u) for t, u in zip(measured, explained, strict=True))
    files = tuple((root / name).resolve() for name in file.data.frequency)
    if files and (done or loop is not None or channels.time_step is not None):
        other = "[loop]" if loop is not None else "[preprocess] or role = 'time_step'"
        raise UserError(f"data.frequency is for records as they were measured: leave {other} out")
    signals = channels.inputs, channels.outputs, channels.sampling_time
    responses = tuple(read_frequency_response(path).of_channels(*signals) for path in files)
    guard_share = file.data.guard_share
    if guard_share is not None:
        division = divided(measured, guard_share, rule, done)
        if not division.guard(measured):
            guard_share = None
        measured, truth = division.train(measured), truth and division.truth(truth)
    train = done.records(measured, channels.inputs)
    require_length(train, rule)
    check_period(train, file.data.period)
    for index, name in enumerate(outputs):
        value = float(train[0].y[0, index])
        if all((t.y[:, index] == value).all() for t in train):
            raise UserError(
                f"output '{name}' is {value:g} in every training sample: there is nothing "
                "to identify; name another column or bring records in which it moves"
            )
    found = Problem(
        name="",
        description="",
        sampling_time=channels.sampling_time * done.decimate,
        inputs=channels.inputs,
        outputs=channels.outputs,
        train=train,
        data=data,
        test=TestSource(test_source(file.data, data, root)),
        protocol=rule,
        budget=file.budget,
        physics=physics,
        plant=plant,
        truth=None if done else truth,
        preprocess=done,
        recorded=channels if done else None,
        warnings=records.warnings,
        readings=records.readings,
        symmetry=file.symmetry,
        period=file.data.period,
        loop=loop,
        guard_share=guard_share,
        responses=responses,
        response_files=files,
    )
    if file.control is None or plant is None:
        return found
    return control_problem(replace(found, plant=None), file.control, plant)
