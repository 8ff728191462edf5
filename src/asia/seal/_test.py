"""The only opener of test outputs."""

from __future__ import annotations

from pathlib import Path

from asia.data import Trajectory
from asia.data._copies import shared_samples
from asia.data._digest import data_digest
from asia.data._store import SealHead, find_key, key_folder, read_seal
from asia.data.sources.kinds import CsvSource, SealedSource
from asia.data.sources.records import Channels, read_records, sealed_records
from asia.errors import UserError
from asia.problem._problem import Problem, Seal
from asia.protocol._cuts import least_case

__all__ = ["Seal", "check_openable", "open_test", "seal"]


def seal(problem: Problem) -> Seal:
    """Reads the test records, checks that they can be scored, keeps their digest and drops them.
    What an encrypted store tells without its key is all that is read of it.

    Raises UserError when they cannot be read, do not fit the problem, or are too short for the
    past window and protocol.test.skip, or for one window.
    """
    if problem.test.source is None:
        return Seal(None)
    if isinstance(problem.test.source, SealedSource):
        head = _head(problem, problem.test.source)
        found = Seal(
            sha256=head.sha256,
            names=tuple(Path(file.name).stem for file in head.files),
            lengths=tuple(file.samples for file in head.files),
            shared_samples=head.shared_samples,
        )
    else:
        records = _read(problem, key_folder())
        found = Seal(
            sha256=data_digest(records),
            names=tuple(r.name for r in records),
            lengths=tuple(len(r) for r in records),
            shared_samples=shared_samples(records, problem.train),
        )
    _check_lengths(problem, found)
    return found


def check_openable(problem: Problem, keys: Path | None = None) -> None:
    """Raises UserError when the test is sure not to open: its file or its key is not there. keys:
    the folder of keys, None for the person's own."""
    source = problem.test.source
    if isinstance(source, SealedSource):
        find_key(source.path, _head(problem, source), key_folder(keys))
    elif isinstance(source, CsvSource):
        for path in source.paths:
            if not path.is_file():
                raise UserError(f"no such file: {path}; put the test data back")


def open_test(problem: Problem, keys: Path | None = None) -> tuple[Trajectory, ...]:
    """The test records. keys: as in `check_openable`. Raises UserError when there are none, when
    the key is missing, or when they are not the ones that were sealed."""
    if problem.test.source is None:
        raise UserError(
            f"problem '{problem.name}' has no test data: name some in [data] test and start a "
            "new run"
        )
    records = _read(problem, key_folder(keys))
    source = problem.test.source
    sealed = source.sha256 if isinstance(source, SealedSource) else None
    if any(d is not None and data_digest(records) != d for d in (problem.test.sha256, sealed)):
        raise UserError(
            f"the test data of problem '{problem.name}' changed since they were sealed: put them "
            "back, or start a new run"
        )
    return records


def _read(problem: Problem, keys: Path) -> tuple[Trajectory, ...]:
    source = problem.test.source
    assert source is not None
    channels = Channels(problem.inputs, problem.outputs, problem.sampling_time)
    if isinstance(source, SealedSource):
        return sealed_records(source, channels, keys).trajectories
    return read_records(source, "test", channels).trajectories


def _head(problem: Problem, source: SealedSource) -> SealHead:
    """What the store tells, when it is the problem's."""
    head = read_seal(source.path)
    if head.sha256 != source.sha256:
        raise UserError(
            f"{source.path} holds other test data than problem '{problem.name}' names: bring the "
            "store that was written with this problem.toml"
        )
    for what, there, now in (
        ("inputs", ", ".join(head.inputs), ", ".join(s.name for s in problem.inputs)),
        ("outputs", ", ".join(head.outputs), ", ".join(s.name for s in problem.outputs)),
        ("sampling_time", f"{head.sampling_time!r} s", f"{problem.sampling_time!r} s"),
    ):
        if there != now:
            raise UserError(
                f"{source.path} was sealed with {what} {there}, and problem '{problem.name}' has "
                f"{now}: put {what} back in problem.toml"
            )
    return head


def _check_lengths(problem: Problem, found: Seal) -> None:
    rule = problem.protocol
    least = rule.past + rule.test.skip + least_case(rule)
    for name, length in zip(found.names, found.lengths, strict=True):
        if rule.horizon is not None and length < least:
            raise UserError(
                f"test record '{name}' has {length} samples, but the past window and one window "
                f"of {rule.horizon} need {least}: bring a longer record"
            )
        if length < least:
            raise UserError(
                f"test record '{name}' has {length} samples, but the past window and "
                f"protocol.test.skip leave out {least - 1}: shorten them or bring a longer record"
            )
