"""The only reader of guard records."""

from __future__ import annotations

from asia.data import Trajectory
from asia.data._digest import data_digest
from asia.errors import UserError
from asia.problem._problem import Problem, prepared
from asia.protocol._cuts import least_case

__all__ = ["guard_digest", "open_guard"]


def guard_digest(problem: Problem) -> str | None:
    """Digest of the guard records, which are read, checked and dropped; None without any.

    Raises:
        UserError: when they cannot be read, do not fit the problem, or are too short for one
            case
    """
    if not problem.data.guard_names:
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
    return prepared(problem, problem.data.records("guard", problem.channels).trajectories)
