"""Advice from the public header of the sealed test."""

from __future__ import annotations

from fnmatch import fnmatchcase

from asia.problem._problem import Problem, Seal
from asia.protocol._rules import ProtocolRule

_FEW_SCORED = 50
_OUTSIDE = 0.01


def sealed_doubts(problem: Problem, seal: Seal, *, in_workspace: bool) -> list[str]:
    """Sentences on a test that is missing, short, not unseen, or beyond the training inputs."""
    doubts: list[str] = []
    if seal.sha256 is None and not in_workspace:
        doubts.append("there is no test data: the winner cannot be judged on unseen records")
    doubts += [
        f"test record '{name}' has {scored} samples to score, after the past window and "
        f"protocol.test.skip: fewer than {_FEW_SCORED} say little about a model"
        for name, scored in zip(seal.names, scored_samples(seal, problem.protocol), strict=True)
        if scored < _FEW_SCORED
    ]
    doubts += [
        f"[protocol.test.figures] {figure.name} names no test record (they are "
        f"{', '.join(seal.names)}): there will be no official figures"
        for figure in problem.protocol.test.figures
        if seal.names and not any(fnmatchcase(n, p) for n in seal.names for p in figure.records)
    ]
    if seal.shared_samples:
        doubts.append(
            f"{seal.shared_samples} test samples also occur, in runs of ten or more, in the "
            "training records: the test is not unseen"
        )
    doubts += [
        f"{count} of {sum(seal.lengths)} test samples of input {given.name} are outside its "
        "range in the training records: a model must extrapolate there"
        for given, count in zip(problem.inputs, seal.outside_inputs, strict=False)
        if count > _OUTSIDE * sum(seal.lengths)
    ]
    return doubts


def scored_samples(seal: Seal, rule: ProtocolRule) -> tuple[int, ...]:
    """Return the number of scored samples of each test record."""
    return tuple(max(length - rule.past - rule.test.skip, 0) for length in seal.lengths)
