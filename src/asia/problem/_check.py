"""Summary of a problem and warnings about its data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from asia.data._digest import data_digest
from asia.data._trajectory import Array, Signal, Trajectory
from asia.problem._digest import protocol_digest
from asia.problem._problem import Problem, Seal
from asia.problem.advice.data import data_doubts, delay_lines, input_delays, missing_lines
from asia.problem.advice.sealed import scored_samples, sealed_doubts
from asia.problem.frequency import response_lines
from asia.problem.knowledge import correction_lines, prior_lines, symmetry_lines
from asia.protocol._cuts import splits, windows
from asia.protocol._metrics import find_metric
from asia.protocol._rules import ProtocolRule

_ORDER = 50
_ORDER_SAMPLES = 10_000
_STUCK = 0.01
_OVERSAMPLED = 0.005
_TOGETHER = 0.999


@dataclass(frozen=True)
class SignalCheck:
    """One channel over all training samples, in its unit.

    Attributes:
        at_minimum, at_maximum: share of samples at the extreme values, 0 to 1
        bandwidth: frequency in Hz below which 99 % of the power lies, the mean apart
        bandwidth_share: the same over the Nyquist frequency
        excitation_order: numerical rank (to 1e-9) of the covariance of 50 successive samples,
            the order of persistent excitation limited by noise
    """

    signal: Signal
    role: Literal["input", "output"]
    minimum: float
    maximum: float
    mean: float
    std: float
    at_minimum: float
    at_maximum: float
    bandwidth: float
    bandwidth_share: float
    excitation_order: int

    @property
    def constant(self) -> bool:
        """Whether it never moves; std may be above 0 by rounding."""
        return self.minimum == self.maximum


@dataclass(frozen=True)
class TrajectoryCheck:
    """A training record."""

    name: str
    samples: int
    seconds: float
    sha256: str


@dataclass(frozen=True)
class HeldOut:
    """Samples first..last of a record, 1-based and inclusive."""

    record: str
    first: int
    last: int


@dataclass(frozen=True)
class FoldCheck:
    """Samples that one fold holds out.

    Attributes:
        training_samples: samples left to train on
        group: name of the group, None for contiguous folds
        windows: held-out windows, None where whole blocks are simulated
    """

    number: int
    held_out: tuple[HeldOut, ...]
    training_samples: int
    group: str | None = None
    windows: int | None = None


@dataclass(frozen=True)
class CheckReport:
    """Everything `asia check` says, as data."""

    problem: Problem
    seal: Seal
    signals: tuple[SignalCheck, ...]
    records: tuple[TrajectoryCheck, ...]
    folds: tuple[FoldCheck, ...]
    protocol_sha256: str
    physics: str | None
    warnings: tuple[str, ...]
    in_workspace: bool = False
    response: tuple[str, ...] = ()
    delays: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The report as plain text."""
        p = self.problem
        rule = p.protocol
        past = f"{rule.past_inputs} input and {rule.past_outputs} output samples"
        return [
            f"problem {p.name}, sampled every {p.sampling_time:g} s",
            *(_signal_line(s) for s in self.signals),
            *(f"record {r.name}: {r.samples} samples, {r.seconds:g} s" for r in self.records),
            *missing_lines(p),
            *self.delays,
            *self.response,
            *(_fold_line(f) for f in self.folds),
            f"{_cases(rule)}; past window: {past}; V: {find_metric(rule.metric).summary}; "
            f"protocol {self.protocol_sha256[:12]}",
            *_early_stopping_lines(rule),
            *_residuals_lines(rule),
            *_seal_lines(self.seal, rule, in_workspace=self.in_workspace),
            *_kept_lines(p),
            *_guard_lines(p),
            f"physics: {self.physics or 'none'}",
            *_knowledge_lines(p),
            f"baseline: {'baseline.py' if p.baseline else 'none'}",
            *(f"warning: {w}" for w in self.warnings),
        ]


def check_problem(problem: Problem, seal: Seal, *, in_workspace: bool = False) -> CheckReport:
    """Check the training records and the public header of the seal, never the test data.

    Args:
        in_workspace: whether the problem is read from a workspace, which holds no test
    """
    inputs = (_signal_check(problem, "input", i) for i in range(len(problem.inputs)))
    outputs = (_signal_check(problem, "output", i) for i in range(len(problem.outputs)))
    signals = (*inputs, *outputs)
    return CheckReport(
        problem=problem,
        seal=seal,
        signals=signals,
        records=tuple(
            TrajectoryCheck(t.name, len(t), len(t) * t.sampling_time, data_digest([t]))
            for t in problem.train
        ),
        folds=_folds(problem),
        protocol_sha256=protocol_digest(problem),
        physics=_physics_summary(problem),
        warnings=(*problem.warnings, *_doubts(problem, seal, signals, in_workspace=in_workspace)),
        in_workspace=in_workspace,
        response=response_lines(problem),
        delays=delay_lines(problem, input_delays(problem)),
    )


def _signal_check(problem: Problem, role: Literal["input", "output"], index: int) -> SignalCheck:
    parts = [(t.u if role == "input" else t.y)[:, index] for t in problem.train]
    values = np.concatenate(parts)
    low, high = float(values.min()), float(values.max())
    near = 1e-6 * (high - low)
    nyquist = 0.5 / problem.sampling_time
    share = _bandwidth_share(parts)
    return SignalCheck(
        signal=(problem.inputs if role == "input" else problem.outputs)[index],
        role=role,
        minimum=low,
        maximum=high,
        mean=float(values.mean()),
        std=float(values.std()),
        at_minimum=float((values <= low + near).mean()),
        at_maximum=float((values >= high - near).mean()),
        bandwidth=share * nyquist,
        bandwidth_share=share,
        excitation_order=_excitation_order(parts),
    )


def _bandwidth_share(parts: Sequence[Array]) -> float:
    """Share of the Nyquist frequency below which 99 % of the power lies, of the longest record."""
    values = max(parts, key=len)
    # A Hann window: without it the jump between a record's ends looks like fast motion.
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)))) ** 2
    total = power.sum()
    if total <= 0:
        return 0.0
    line = int(np.searchsorted(np.cumsum(power), 0.99 * total))
    return line / max(len(power) - 1, 1)


def _excitation_order(parts: Sequence[Array]) -> int:
    """Ljung, System Identification (2nd ed.), section 13.2: u is persistently exciting of order n
    when the n x n covariance of its successive samples is non-singular."""
    values = max(parts, key=len)[:_ORDER_SAMPLES]
    size = min(_ORDER, len(values) // 4)
    windows = np.lib.stride_tricks.sliding_window_view(values - values.mean(), size)
    return int(np.linalg.matrix_rank(windows.T @ windows, tol=None, rtol=1e-9, hermitian=True))


def _folds(problem: Problem) -> tuple[FoldCheck, ...]:
    rule, train = problem.protocol, problem.train
    names = [group.name for group in rule.folds.groups]
    found = splits([t.name for t in train], [len(t) for t in train], rule)
    return tuple(
        FoldCheck(
            number=k + 1,
            held_out=tuple(
                HeldOut(train[p.record].name, p.samples.start + 1, p.samples.stop)
                for p in split.held_out
            ),
            training_samples=sum(len(p.samples) for p in split.train),
            group=names[k] if names else None,
            windows=None
            if rule.horizon is None
            else sum(len(windows(p.samples, rule)) for p in split.held_out),
        )
        for k, split in enumerate(found)
    )


def _physics_summary(problem: Problem) -> str | None:
    physics = problem.physics
    if physics is None:
        return None
    free = f"{len(physics.parameters)} parameters to fit" if physics.parameters else "no parameters"
    return f"{len(physics.states)} states ({', '.join(physics.states)}), {free}"


def _knowledge_lines(problem: Problem) -> list[str]:
    physics = problem.physics
    lines = [f"symmetry {line}" for line in symmetry_lines(problem.symmetry)]
    if physics is None:
        return lines
    priors = [f"prior {line}" for line in prior_lines(physics)]
    return [*priors, *(f"correction {line}" for line in correction_lines(physics)), *lines]


def _doubts(
    problem: Problem, seal: Seal, signals: Sequence[SignalCheck], *, in_workspace: bool
) -> list[str]:
    doubts = [d for s in signals for d in _signal_doubts(s)]
    doubts += _inputs_together(problem.inputs, problem.train)
    doubts += data_doubts(problem)
    if not problem.description.strip():
        doubts.append("there is no description: agents that read know nothing of the system")
    if problem.protocol.past_outputs == 0:
        doubts.append("past_outputs is 0: a model cannot know the state it starts from")
    doubts += sealed_doubts(problem, seal, in_workspace=in_workspace)
    return doubts


def _signal_doubts(check: SignalCheck) -> list[str]:
    name = f"{check.role} {check.signal.name}"
    if check.constant:
        return [f"{name} is constant: nothing can be learned from it"]
    doubts: list[str] = []
    if check.role == "output":
        for share, value in (
            (check.at_minimum, check.minimum),
            (check.at_maximum, check.maximum),
        ):
            if share > _STUCK:
                doubts.append(
                    f"{name} is at its limit {value:g} {check.signal.unit}".rstrip()
                    + f" in {share:.1%} of the samples: it may saturate there"
                )
        if check.bandwidth_share < _OVERSAMPLED:
            doubts.append(
                f"{name} is sampled much faster than it changes (99 % of its power below "
                f"{check.bandwidth_share:.2%} of the Nyquist frequency): every tenth sample may "
                f"suffice"
            )
    elif check.excitation_order < 4:
        doubts.append(
            f"{name} excites at most {check.excitation_order} modes: use an input with more "
            "frequencies"
        )
    return doubts


def _inputs_together(inputs: Sequence[Signal], train: Sequence[Trajectory]) -> list[str]:
    u = np.concatenate([t.u for t in train])
    centred = u - u.mean(axis=0)
    norms = np.sqrt((centred**2).sum(axis=0))
    return [
        f"inputs {inputs[i].name} and {inputs[j].name} are collinear: their effects cannot be "
        "separated"
        for i, j in combinations(range(u.shape[1]), 2)
        if norms[i] * norms[j] > 0
        and abs(centred[:, i] @ centred[:, j]) > _TOGETHER * norms[i] * norms[j]
    ]


def _cases(rule: ProtocolRule) -> str:
    if rule.horizon is None:
        return "whole blocks are simulated"
    return f"windows of {rule.horizon} samples are simulated"


def _early_stopping_lines(rule: ProtocolRule) -> list[str]:
    if rule.early_stopping == "inner":
        return []
    return [
        "early stopping: on the validation fold, so that V is not leak-free and compares with "
        "other runs of this setting alone"
    ]


def _residuals_lines(rule: ProtocolRule) -> list[str]:
    if rule.residuals == "train":
        return []
    return [
        "residuals: of the held-out samples too, so that V compares with other runs of this "
        "setting alone"
    ]


def _signal_line(s: SignalCheck) -> str:
    if s.constant:
        return f"{s.role} {s.signal.label}: constant at {s.minimum:.4g}"
    at_least = ">= " if s.excitation_order == _ORDER else ""
    order = f", practical excitation order {at_least}{s.excitation_order}"
    return (
        f"{s.role} {s.signal.label}: {s.minimum:.4g} to {s.maximum:.4g}, std {s.std:.4g}, 99 % of "
        f"the power below {s.bandwidth:.3g} Hz ({s.bandwidth_share:.1%} of Nyquist)"
        f"{order if s.role == 'input' else ''}, "
        f"at the extremes {s.at_minimum + s.at_maximum:.1%}"
    )


def _fold_line(fold: FoldCheck) -> str:
    name = f"fold {fold.number}" + (f", {fold.group}" if fold.group else "")
    many = "" if fold.windows is None else f"{fold.windows} windows of "
    # A group's records are held out from end to end.
    parts = ", ".join(
        h.record if fold.group else f"{h.record} {h.first}-{h.last}" for h in fold.held_out
    )
    return f"{name}: holds out {many}{parts}; trains on {fold.training_samples} samples"


def _seal_lines(seal: Seal, rule: ProtocolRule, *, in_workspace: bool) -> list[str]:
    if seal.sha256 is None:
        kept = "not in a workspace; PROGRAM.md says whether the evaluator keeps one, sealed"
        return [f"test: {kept if in_workspace else 'none'}"]
    digest = f"sha256 {seal.sha256[:12]}"
    if rule.horizon is not None:
        counts = [len(windows(range(rule.past, length), rule)) for length in seal.lengths]
        sizes = zip(seal.names, seal.lengths, counts, strict=True)
        records = ", ".join(f"{name} ({length} samples, {n} windows)" for name, length, n in sizes)
        table = "" if not rule.test.groups else f"; {_table_summary(rule)}"
        return [f"test, sealed: {records}; {sum(counts)} windows{table}; {digest}"]
    sizes = zip(seal.names, seal.lengths, scored_samples(seal, rule), strict=True)
    records = ", ".join(
        f"{name} ({length} samples, {scored} scored)" for name, length, scored in sizes
    )
    skipped = f"{rule.test.skip} samples after the past window are skipped"
    return [f"test, sealed: {records}; {skipped}; {digest}"]


def _kept_lines(problem: Problem) -> list[str]:
    source = problem.test.source
    return [] if source is None else [f"test kept: {source.test_kept}"]


def _guard_lines(problem: Problem) -> list[str]:
    names = ", ".join(problem.data.guard_names)
    if not names:
        return []
    return [f"guard: {names}; seen by no fold and no agent, looked at when the search ends"]


def _table_summary(rule: ProtocolRule) -> str:
    groups = ", ".join(
        f"{g.name} ({' '.join(g.outputs)}{', rotation' if g.distance == 'geodesic' else ''})"
        for g in rule.test.groups
    )
    return f"mean Euclidean error of {groups}"
