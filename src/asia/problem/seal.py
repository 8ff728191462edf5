"""Only readers of sealed test outputs and guard records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from asia.data.relations import samples_outside, shared_samples
from asia.data.trajectory import Trajectory, data_digest
from asia.errors import UserError
from asia.problem.folds import least_case
from asia.problem.held_back import divided
from asia.problem.problem import Problem, Seal, prepared

# The only opener of test outputs.


def seal(problem: Problem) -> Seal:
    """Seal the test: read its records, check that they can be scored, and keep only their digest.

    Of an encrypted store only the public header is read.

    Raises:
        UserError: when the records cannot be read, do not fit the problem, or are too short for
            the past window and protocol.test.skip, or for one window
    """
    source = problem.test.source
    if source is None:
        return Seal(None)
    outline = source.outline(problem.channels)
    if outline is not None:
        lengths = tuple(problem.preprocess.length(n) for n in outline.lengths)
        found = replace(Seal(**vars(outline)), lengths=lengths)
    else:
        measured = source.records("test", problem.channels).trajectories
        records = prepared(problem, measured)
        found = Seal(
            sha256=data_digest(measured),
            names=tuple(r.name for r in records),
            lengths=tuple(len(r) for r in records),
            shared_samples=shared_samples(records, problem.train),
            outside_inputs=samples_outside(records, problem.train),
        )
    rule = problem.protocol
    least = rule.past + rule.test.skip + least_case(rule)
    for name, length in zip(found.names, found.lengths, strict=True):
        if length >= least:
            continue
        if rule.horizon is not None:
            raise UserError(
                f"test record '{name}' has {length} samples, but the past window and one window "
                f"of {rule.horizon} need {least}: bring a longer record"
            )
        raise UserError(
            f"test record '{name}' has {length} samples, but the past window and "
            f"protocol.test.skip leave out {least - 1}: shorten them or bring a longer record"
        )
    return found


def check_openable(problem: Problem, keys: Path | None = None) -> None:
    """Check that the file of the test and its key exist.

    Args:
        keys: folder of keys, None for that of the user

    Raises:
        UserError: when the test cannot be opened
    """
    if problem.test.source is not None:
        problem.test.source.with_keys(keys).check_openable()


def open_test(problem: Problem, keys: Path | None = None) -> tuple[Trajectory, ...]:
    """The test records.

    Args:
        keys: as in `check_openable`

    Raises:
        UserError: when there are none, when the key is missing, or when they are not the ones
            that were sealed
    """
    source = problem.test.source
    if source is None:
        raise UserError(
            f"problem '{problem.name}' has no test data: name some in [data] test and start a "
            "new run"
        )
    records = source.with_keys(keys).records("test", problem.channels).trajectories
    if any(d not in (None, data_digest(records)) for d in (problem.test.sha256, source.sha256)):
        raise UserError(
            f"the test data of problem '{problem.name}' changed since they were sealed: put them "
            "back, or start a new run"
        )
    return prepared(problem, records)


# The only reader of guard records.


def guard_digest(problem: Problem) -> str | None:
    """Digest of the guard records, which are read, checked and dropped; None without any.

    Raises:
        UserError: when they cannot be read, do not fit the problem, or are too short for one
            case
    """
    if not problem.guard_names:
        return None
    records = _read(problem)
    least = problem.protocol.past + least_case(problem.protocol)
    for record in records:
        if len(record) < least:
            raise UserError(
                f"guard record '{record.name}' has {len(record)} samples, but the past window and "
                f"one case need {least}: bring a longer record"
            )
        for other in problem.train:
            if data_digest([other]) == data_digest([record]):
                raise UserError(
                    f"guard record '{record.name}' is training record '{other.name}': guard with "
                    "a record that nothing is trained on"
                )
    return data_digest(records)


def open_guard(problem: Problem) -> tuple[Trajectory, ...]:
    """The guard records.

    Raises:
        UserError: when they are not those the run began with
    """
    records = _read(problem)
    if problem.guard_sha256 is not None and data_digest(records) != problem.guard_sha256:
        raise UserError(
            f"the guard records of problem '{problem.name}' changed since the run began: put them "
            "back, or start a new run"
        )
    return records


def _read(problem: Problem) -> tuple[Trajectory, ...]:
    if problem.guard_share is None:
        return prepared(problem, problem.data.records("guard", problem.channels).trajectories)
    records = problem.data.records("train", problem.channels).trajectories
    division = divided(records, problem.guard_share, problem.protocol, problem.preprocess)
    return prepared(problem, division.guard(records))
