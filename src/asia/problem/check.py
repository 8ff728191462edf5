"""Findings of `asia check`: the problem as understood, and doubtful data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Literal

import numpy as np

from asia.data.bad_samples import find_bad_samples
from asia.data.frequency import FrequencyResponse, find_period, frequency_response
from asia.data.intake.conversion import NOT_MEASURED
from asia.data.level_responses import describe_levels
from asia.data.relations import Repetition, find_repetition
from asia.data.statistics import (
    FALSE_ALARMS,
    Delay,
    at_once,
    delays,
    drifts,
    feedback,
    limit_shares,
    staircases,
)
from asia.data.trajectory import INTERSAMPLE, Array, Signal, Trajectory, is_constant
from asia.errors import UserError
from asia.problem.feedback import loop_lines
from asia.problem.folds import splits, windows
from asia.problem.identifiability import Unidentifiable, unidentifiable
from asia.problem.lock import protocol_digest
from asia.problem.metrics import find_metric
from asia.problem.problem import (
    Problem,
    Seal,
    correction_lines,
    is_described,
    prior_lines,
    symmetry_lines,
)
from asia.problem.protocol import ProtocolRule

_HIGHEST_ORDER = 50
_BAD = {"outlier": 0.3, "code": 0.7, "frozen": 0.7, "overflow": 0.9}


@dataclass(frozen=True)
class Doubt:
    """A finding that limits what can be learned from the records."""

    text: str
    weight: float
    """1 or more: not enough for a model; 0.3 or more: limits its use."""
    experiment: str = ""
    """Measurement that would help; empty where none would."""

    def __str__(self) -> str:
        return self.text


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
    std: float
    at_minimum: float
    at_maximum: float
    bandwidth: float
    bandwidth_share: float
    excitation_order: int

    @property
    def constant(self) -> bool:
        """Whether it moves by no more than its rounding."""
        return is_constant(np.array([self.minimum, self.maximum]))


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
    """Everything `asia check` says."""

    problem: Problem
    seal: Seal
    signals: tuple[SignalCheck, ...]
    folds: tuple[FoldCheck, ...]
    doubts: tuple[Doubt, ...]
    unidentifiable: tuple[Unidentifiable, ...] | None = ()
    """Parameters of the equations that no record can determine; None where that is unknown."""
    in_workspace: bool = False

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on everything doubtful."""
        return (*self.problem.warnings, *map(str, self.doubts))

    def lines(self) -> list[str]:
        """The report as plain text."""
        problem, rule, physics = self.problem, self.problem.protocol, self.problem.physics
        place = problem.channels.time_step
        lines = [f"problem {problem.name}, sampled every {problem.sampling_time:g} s"]
        if place is not None:
            steps = np.concatenate([t.u[:, place] for t in problem.train])
            lines = [
                f"problem {problem.name}, sampled irregularly, every {steps.min():.3g} to "
                f"{steps.max():.3g} s, median {np.median(steps):.3g} s: equations are integrated "
                "from sample to sample; spectra, delays, feedback and a linear model need one "
                "sampling time and are left out"
            ]
        lines += [f"read: {text}" for text in problem.readings]
        lines += [_signal_line(s, irregular=place is not None) for s in self.signals]
        lines += between_lines(problem)
        lines += [
            f"record {t.name}: {len(t)} samples, "
            f"{len(t) * t.sampling_time if place is None else t.u[:, place].sum():g} s"
            for t in problem.train
        ]
        lines += [
            f"frequency response {one.name}: {len(one.frequency)} frequencies from "
            f"{one.frequency[0]:.4g} to {one.frequency[-1]:.4g} Hz, "
            f"{'continuous time' if not one.sampling_time else 'sampled like the records'}: linear "
            "models are fitted to it too; a response estimated from these records would show them "
            "what the folds hold out"
            for one in problem.responses
        ]
        lines += [_missing_line(problem), *delay_lines(problem), *level_lines(problem)]
        lines += response_lines(problem)
        lines += map(_fold_line, self.folds)
        if rule.horizon is None:
            cases = "whole blocks are simulated"
        else:
            cases = f"windows of {rule.horizon} samples are simulated"
        lines.append(
            f"{cases}; past window: {rule.past_inputs} input and {rule.past_outputs} output "
            f"samples; V: {find_metric(rule.metric).summary}; "
            f"protocol {protocol_digest(problem)[:12]}"
        )
        if rule.early_stopping != "inner":
            lines.append(
                "early stopping: on the validation fold, so that V is not leak-free and compares "
                "with other runs of this setting alone"
            )
        if rule.residuals != "train":
            lines.append(
                "residuals: of the held-out samples too, so that V compares with other runs of "
                "this setting alone"
            )
        lines.append(_seal_line(self.seal, rule, in_workspace=self.in_workspace))
        if problem.test.source is not None:
            lines.append(f"test kept: {problem.test.source.test_kept}")
        if problem.guard_names:
            lines.append(
                f"guard: {', '.join(problem.guard_names)}; seen by no fold and no agent, "
                "looked at when the search ends"
            )
        if physics is None:
            lines.append("physics: no equations in problem.toml")
        else:
            count = len(physics.parameters)
            free = f"{count} parameters to fit" if count else "no parameters"
            states = f"{len(physics.states)} states ({', '.join(physics.states)})"
            lines.append(f"physics: {states}, {free}")
            lines += [f"prior {line}" for line in prior_lines(physics)]
            lines += [f"correction {line}" for line in correction_lines(physics)]
            if self.unidentifiable is None:
                lines.append(
                    "identifiability: not tested, the equations have delays or could not be "
                    "simulated"
                )
            elif physics.parameters and not self.unidentifiable:
                lines.append("identifiability: records can determine every parameter in principle")
            lines += [f"identifiability: {one}" for one in self.unidentifiable or ()]
        lines += [f"symmetry {line}" for line in symmetry_lines(problem.symmetry)]
        if problem.loop is not None:
            lines += loop_lines(problem.loop, problem.train, whole=rule.horizon is None)
        own = "baseline.py" if problem.baseline else "built-in; a baseline.py would replace it"
        lines.append(f"baseline: {own}")
        # The line on missing outputs has said that for all files.
        return lines + [f"warning: {w}" for w in self.warnings if NOT_MEASURED not in w]


def check_problem(problem: Problem, seal: Seal, *, in_workspace: bool = False) -> CheckReport:
    """Check the training records and the public header of the seal, never the test data.

    Args:
        in_workspace: whether the problem is read from a workspace, which holds no test
    """
    signals = (
        *(
            _signal_check(s, "input", [t.u[:, i] for t in problem.train], problem.sampling_time)
            for i, s in enumerate(problem.inputs)
        ),
        *(
            _signal_check(s, "output", [t.y[:, i] for t in problem.train], problem.sampling_time)
            for i, s in enumerate(problem.outputs)
        ),
    )
    doubts: list[Doubt] = []
    if problem.channels.time_step is None:
        doubts += [d for s in signals for d in _signal_doubts(s)]
        doubts += _limit_doubts(problem)
        doubts += _collinear_inputs(problem)
        doubts += data_doubts(problem)
        doubts += _repeated_inputs(problem)
    if not is_described(problem.description):
        text = "the description is empty: a language model knows only the names of the signals"
        doubts.append(Doubt(text, 0.05))
    if problem.protocol.past_outputs == 0:
        text = "past_outputs is 0: a model cannot know the state it starts from"
        doubts.append(Doubt(text, 0.2))
    doubts += _sealed_doubts(problem, seal, in_workspace=in_workspace)
    unknown: tuple[Unidentifiable, ...] | None = ()
    if problem.physics is not None:
        inputs, outputs = ([one.name for one in s] for s in (problem.inputs, problem.outputs))
        found = unidentifiable(problem.physics, inputs, outputs, problem.train)
        unknown = None if found is None else tuple(found)
    return CheckReport(
        problem=problem,
        seal=seal,
        signals=signals,
        folds=_folds(problem),
        doubts=tuple(doubts),
        unidentifiable=unknown,
        in_workspace=in_workspace,
    )


# Signals and folds.


def _signal_check(
    signal: Signal, role: Literal["input", "output"], parts: Sequence[Array], sampling_time: float
) -> SignalCheck:
    values = np.concatenate(parts)
    low, high = float(values.min()), float(values.max())
    near = 1e-6 * (high - low)
    # A Hann window: without it the jump between a record's ends looks like fast motion.
    spectra = [np.abs(np.fft.rfft((v - v.mean()) * np.hanning(len(v)))) ** 2 for v in parts]
    power = np.concatenate(spectra)
    frequency = np.concatenate([np.arange(len(s)) / max(len(s) - 1, 1) for s in spectra])
    rising = np.argsort(frequency, kind="stable")
    line = int(np.searchsorted(np.cumsum(power[rising]), 0.99 * power.sum()))
    share = float(frequency[rising[line]]) if power.sum() > 0 else 0.0
    # Ljung, System Identification (2nd ed.), section 13.2: u is persistently exciting of order n
    # when the n x n covariance of its successive samples is non-singular.
    starts = [v[:10_000] for v in parts]
    size = min(_HIGHEST_ORDER, max(map(len, starts)) // 4)
    covariance = np.zeros((size, size))
    for v in (v - v.mean() for v in starts if len(v) >= size):
        rows = np.lib.stride_tricks.sliding_window_view(v, size)
        covariance += rows.T @ rows
    order = int(np.linalg.matrix_rank(covariance, tol=None, rtol=1e-9, hermitian=True))
    return SignalCheck(
        signal=signal,
        role=role,
        minimum=low,
        maximum=high,
        std=float(values.std()),
        at_minimum=float((values <= low + near).mean()),
        at_maximum=float((values >= high - near).mean()),
        bandwidth=share * (0.5 / sampling_time),
        bandwidth_share=share,
        excitation_order=order,
    )


def _signal_line(s: SignalCheck, *, irregular: bool) -> str:
    if s.constant:
        return f"{s.role} {s.signal.label}: constant at {s.minimum:.4g}"
    if irregular:
        return (
            f"{s.role} {s.signal.label}: {s.minimum:.4g} to {s.maximum:.4g}, std {s.std:.4g}, "
            f"at the extremes {s.at_minimum + s.at_maximum:.1%}"
        )
    at_least = ">= " if s.excitation_order == _HIGHEST_ORDER else ""
    order = f", practical excitation order {at_least}{s.excitation_order}"
    return (
        f"{s.role} {s.signal.label}: {s.minimum:.4g} to {s.maximum:.4g}, std {s.std:.4g}, 99 % of "
        f"the power below {s.bandwidth:.3g} Hz ({s.bandwidth_share:.1%} of Nyquist)"
        f"{order if s.role == 'input' else ''}, "
        f"at the extremes {s.at_minimum + s.at_maximum:.1%}"
    )


def _signal_doubts(check: SignalCheck) -> list[Doubt]:
    name = f"{check.role} {check.signal.name}"
    if check.constant:
        text = f"{name} is constant: nothing can be learned from it"
        output = check.role == "output"
        return [Doubt(text, 2.0 if output else 0.8, "" if output else f"move {name}")]
    if check.role == "input":
        if check.excitation_order >= 4:
            return []
        text = (
            f"{name} excites at most {check.excitation_order} modes: use an input with more "
            "frequencies"
        )
        return [Doubt(text, 0.9, "a random binary or multisine input on " + name)]
    if check.bandwidth_share < 0.005:
        text = (
            f"{name} is sampled much faster than it changes (99 % of its power below "
            f"{check.bandwidth_share:.2%} of the Nyquist frequency): every tenth sample may suffice"
        )
        return [Doubt(text, 0.2)]
    return []


def _limit_doubts(problem: Problem) -> list[Doubt]:
    """Outputs that inputs drive against a limit."""
    y = np.concatenate([t.y for t in problem.train])
    ends = zip(y.min(axis=0).tolist(), y.max(axis=0).tolist(), strict=True)
    return [
        Doubt(
            f"output {output.name} is at its limit {value:g} {output.unit}".rstrip()
            + f" in {share:.1%} of the samples: it may saturate there",
            0.25 + share,
            f"smaller inputs, so that output {output.name} stays away from {value:g}",
        )
        for output, limits, shares in zip(
            problem.outputs, ends, limit_shares(problem.train), strict=True
        )
        for value, share in zip(limits, shares, strict=True)
        if share > 0.01
    ]


def _collinear_inputs(problem: Problem) -> list[Doubt]:
    u = np.concatenate([t.u for t in problem.train])
    centred = u - u.mean(axis=0)
    norms = np.sqrt((centred**2).sum(axis=0))
    names = [signal.name for signal in problem.inputs]
    return [
        Doubt(
            f"inputs {names[i]} and {names[j]} are collinear: their effects cannot be separated",
            0.9,
            f"move {names[i]} and {names[j]} independently",
        )
        for i, j in combinations(range(len(names)), 2)
        if norms[i] * norms[j] > 0
        and abs(centred[:, i] @ centred[:, j]) > 0.999 * norms[i] * norms[j]
    ]


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


def _repeated_inputs(problem: Problem) -> list[Doubt]:
    """Describe inputs that held-out and training samples share, and propose folds without."""
    train = problem.train
    names, lengths = [r.name for r in train], [len(r) for r in train]

    def repetition(rule: ProtocolRule) -> Repetition | None:
        parts = [
            (
                [(p.record, p.samples) for p in cut.held_out],
                [(p.record, p.samples) for p in cut.train],
            )
            for cut in splits(names, lengths, rule)
        ]
        return find_repetition([r.u for r in train], parts)

    rule = problem.protocol
    found, grouped = repetition(rule), rule.folds.kind == "leave_one_group_out"
    # A period of few frequencies is not rich enough to be told from chance by one segment.
    known = None if grouped or rule.folds.period else problem.period or find_period(train)
    if found is None and known is None:
        return []
    here = found is None or found.record == found.other
    if found is None or (here and known):
        period, text = known or 0, f"the inputs repeat every {known} samples"
        text += ", so that each fold simulates inputs that it was trained on"
    else:
        period = abs(found.start - found.other_start)
        how = "occur" if found.gain > 0 else "occur with the opposite sign"
        if abs(abs(found.gain) - 1.0) > 0.02:
            how += f", scaled by {abs(1 / found.gain):.2g},"
        text = (
            f"the inputs of samples {found.start + 1} to {found.start + found.length} of record "
            f"'{names[found.record]}', which fold {found.fold + 1} holds out, {how} "
            + (f"{period} samples {'earlier' if found.start > found.other_start else 'later'} "
               if here else f"in record '{names[found.other]}' ")
            + "in its training samples"
        )  # fmt: skip
    text += ": V is too good"
    if not here and found is not None:
        pair = f"'{names[found.record]}' and '{names[found.other]}'"
        advice = f"put {pair} into one group of [data.groups], with folds = "
        advice += '{ kind = "leave_one_group_out" }'
    elif grouped:
        advice = "record a new input for each group"
    else:
        advice = "hold out a record with other inputs"
        least = rule.past + max(10, rule.horizon or 1)
        for count in range(min(rule.folds.count, period // max(least, 1)), 1, -1):
            folds = replace(rule.folds, kind="contiguous", count=count, tail=None, period=period)
            if repetition(replace(rule, folds=folds)) is None:
                line = f'folds = {{ kind = "contiguous", count = {count}, period = {period} }}'
                advice = f"write {line} into [protocol] of problem.toml, which holds out the same "
                advice += "part of every period"
                break
    return [Doubt(f"{text}. To mend it, {advice}", 0.5, "a record with other inputs")]


def _fold_line(fold: FoldCheck) -> str:
    name = f"fold {fold.number}" + (f", {fold.group}" if fold.group else "")
    many = "" if fold.windows is None else f"{fold.windows} windows of "
    # A group's records are held out from end to end.
    parts = ", ".join(
        h.record if fold.group else f"{h.record} {h.first}-{h.last}" for h in fold.held_out
    )
    return f"{name}: holds out {many}{parts}; trains on {fold.training_samples} samples"


# Delays and feedback.


@dataclass(frozen=True)
class InputDelay:
    """Delay from an input to an output, by their names."""

    given: str
    output: str
    delay: Delay


def input_delays(problem: Problem) -> tuple[InputDelay, ...]:
    """Every output with every input, where both move; none for short or irregular records."""
    if problem.channels.time_step is not None:
        return ()
    found = delays(problem.train)
    return tuple(
        InputDelay(given.name, output.name, delay)
        for output, row in zip(problem.outputs, found, strict=True)
        for given, delay in zip(problem.inputs, row, strict=True)
        if delay is not None
    )


def between_lines(problem: Problem) -> list[str]:
    """Say of each input how it behaves between samples: by the problem file, or by the records."""
    u = np.concatenate([t.u for t in problem.train])
    stairs = staircases(problem.train)
    quick = np.full((len(problem.inputs), len(problem.outputs)), np.nan)
    if problem.channels.time_step is None:
        quick = at_once(problem.train)
    lines: list[str] = []
    compared = "models in continuous time are compared with held, linear and band-limited inputs"
    for j, signal in enumerate(problem.inputs):
        if signal.role == "time_step" or is_constant(u[:, j]):
            continue
        followed = [
            o.name for o, c in zip(problem.outputs, quick[j], strict=True) if c < FALSE_ALARMS
        ]
        if signal.intersample is not None:
            text = f"{INTERSAMPLE[signal.intersample]} between samples, by the problem file"
        elif stairs[j]:
            text = "held between samples: it is constant over several at a time"
        elif followed:
            text = (
                f"{', '.join(followed)} depends on it in the same sample, so it is not held "
                f"between samples, acts at once, or is computed from that output; {compared}"
            )
        else:
            text = f"the records do not show how it behaves between samples; {compared}"
        lines.append(f"input {signal.name}: {text}")
    return lines


def delay_lines(problem: Problem) -> list[str]:
    """Describe the delay from each input to each output, and the pairs where feedback was not
    tested."""
    found = input_delays(problem)
    if not found:
        return []
    lines: list[str] = []
    for output in problem.outputs:
        texts = [f"{a.given} {_delay_text(a.delay)}" for a in found if a.output == output.name]
        if texts:
            lines.append(f"delay of output {output.name} in samples: {', '.join(texts)}")
    lines += [
        f"delay 0: output {a.output} responds to input {a.given} in the same sample. If the system "
        "cannot be so fast, a controller computes the input from that output"
        for a in found
        if a.delay.lag == 0
    ]
    tested = [bool(np.isfinite(row).any()) for row in feedback(problem.train)]
    moving = {a.given for a in found}
    untested = [
        given.name
        for given, known in zip(problem.inputs, tested, strict=True)
        if given.name in moving and not known
    ]
    if untested:
        lines.append(
            f"feedback: not tested for input {', '.join(untested)}, which its own past predicts"
        )
    return lines


def level_lines(problem: Problem) -> list[str]:
    """Describe how gains, delays and time constants depend on the level of a signal."""
    if problem.channels.time_step is not None:
        return []
    return describe_levels(problem.train, problem.inputs, problem.outputs)


def _delay_text(delay: Delay) -> str:
    if delay.lag is None:
        return "none found"
    if delay.interval is None:
        return f"{delay.lag} (first significant correlation)"
    low, high = delay.interval
    return f"{delay.lag}" if low == high else f"{delay.lag} ({low} to {high})"


# Missing outputs, feedback, drift, converter steps and bad samples of training records.


def _missing_line(problem: Problem) -> str:
    measured = np.concatenate([r.measured for r in problem.train])
    found = [
        f"{output.name} {int(lost)} of {len(measured)}"
        for output, lost in zip(problem.outputs, (~measured).sum(axis=0), strict=True)
        if lost
    ]
    if not found:
        return "missing values: none"
    return f"missing outputs, in samples, left out of fit and V: {', '.join(found)}"


def feedback_pairs(problem: Problem) -> list[tuple[Signal, Signal]]:
    """Inputs that follow earlier values of outputs, where [loop] does not explain them."""
    measured = problem.loop is None or problem.loop.inputs == "measured"
    if not measured or problem.channels.time_step is not None:
        return []
    return [
        (problem.inputs[i], problem.outputs[j])
        for i, j in np.argwhere(feedback(problem.train) < FALSE_ALARMS).tolist()
    ]


def data_doubts(problem: Problem) -> list[Doubt]:
    """Sentences on feedback, drift, converter steps and bad samples."""
    doubts = [
        Doubt(
            f"input {given.name} follows earlier values of output {output.name}: it may come from "
            "a controller, and a model fitted in closed loop may describe the controller instead "
            "of the system" + ("" if problem.loop else ": name the measured reference in [loop]"),
            0.6,
            "an open loop, or known random signals added to the inputs",
        )
        for given, output in feedback_pairs(problem)
    ]
    names = [[s.name for s in side] for side in (problem.inputs, problem.outputs)]
    doubts += [Doubt(str(one), _BAD[one.kind]) for one in find_bad_samples(problem.train, *names)]
    for j, output in enumerate(problem.outputs):
        name, unit = f"output {output.name}", f" {output.unit}".rstrip()
        parts = [r.y[:, j] for r in problem.train]
        values = np.concatenate(parts)
        if not is_constant(values):
            doubts += _drift(problem.train, j, name, unit)
            doubts += _quantization(values, name, unit)
    return doubts


def _drift(records: Sequence[Trajectory], output: int, name: str, unit: str) -> list[Doubt]:
    """Describe a drift of the longest record."""
    rise = drifts(records)[output]
    if rise == 0.0:
        return []
    text = (
        f"{name} {'rises' if rise > 0 else 'falls'} by {abs(rise):.3g}{unit} over record "
        f"'{max(records, key=len).name}', more than its other variation, and no input explains it: "
        "the sensor may drift, or the record starts far from steady state"
    )
    return [Doubt(text, 0.4, "a longer record that starts at rest")]


def _quantization(values: Array, name: str, unit: str) -> list[Doubt]:
    """Describe a quantization step that is large relative to the signal."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * (levels[-1] - levels[0])]
    step, std = float(gaps.min()), float(values.std())
    multiples = (levels - levels[0]) / step
    if len(gaps) < 2 or step <= 0.05 * std or np.abs(multiples - np.round(multiples)).max() > 1e-3:
        return []
    share = step / np.sqrt(12.0) / std
    text = (
        f"{name} is quantized in steps of {step:.3g}{unit}: this alone causes an error of about "
        f"{share:.1%} of its standard deviation"
    )
    return [Doubt(text, 0.2 + 2.0 * share, f"larger inputs, or a finer sensor for {name}")]


# The sealed test, from its public header.


def _scored_samples(seal: Seal, rule: ProtocolRule) -> list[int]:
    return [max(length - rule.past - rule.test.skip, 0) for length in seal.lengths]


def _seal_line(seal: Seal, rule: ProtocolRule, *, in_workspace: bool) -> str:
    if seal.sha256 is None and in_workspace:
        return "test: not in a workspace; PROGRAM.md says whether the evaluator keeps one, sealed"
    if seal.sha256 is None:
        return "test: none"
    digest = f"sha256 {seal.sha256[:12]}"
    if rule.horizon is None:
        sizes = zip(seal.names, seal.lengths, _scored_samples(seal, rule), strict=True)
        records = ", ".join(f"{name} ({length} samples, {n} scored)" for name, length, n in sizes)
        skip = f"; {rule.test.skip} samples after the past window are skipped"
        return f"test: {records}{skip if rule.test.skip else ''}; {digest}"
    counts = [len(windows(range(rule.past, length), rule)) for length in seal.lengths]
    sizes = zip(seal.names, seal.lengths, counts, strict=True)
    records = ", ".join(f"{name} ({length} samples, {n} windows)" for name, length, n in sizes)
    groups = ", ".join(
        f"{g.name} ({' '.join(g.outputs)}{', rotation' if g.distance == 'geodesic' else ''})"
        for g in rule.test.groups
    )
    table = f"; mean Euclidean error of {groups}" if groups else ""
    return f"test: {records}; {sum(counts)} windows{table}; {digest}"


def _sealed_doubts(problem: Problem, seal: Seal, *, in_workspace: bool) -> list[Doubt]:
    """Sentences on a test that is missing, short, not unseen, or beyond the training inputs."""
    doubts: list[Doubt] = []
    if seal.sha256 is None and not in_workspace:
        text = "there is no test data: the best candidate cannot be judged on unseen records"
        doubts.append(Doubt(text, 0.3, "one more record, kept as the test"))
    least = 50
    doubts += [
        Doubt(
            f"test record '{name}' has {scored} samples to score, after the past window and "
            f"protocol.test.skip: fewer than {least} say little about a model",
            0.3,
            "a longer record as the test",
        )
        for name, scored in zip(seal.names, _scored_samples(seal, problem.protocol), strict=True)
        if scored < least
    ]
    doubts += [
        Doubt(
            f"[protocol.test.figures] {figure.name} names no test record (they are "
            f"{', '.join(seal.names)}): there will be no official figures",
            0.1,
        )
        for figure in problem.protocol.test.figures
        if seal.names and not any(fnmatchcase(n, p) for n in seal.names for p in figure.records)
    ]
    if seal.shared_samples:
        text = (
            f"{seal.shared_samples} test samples also occur, in runs of ten or more, in the "
            "training records: the test is not unseen"
        )
        doubts.append(Doubt(text, 0.4, "a new record as the test"))
    doubts += [
        Doubt(
            f"{count} of {sum(seal.lengths)} test samples of input {given.name} are outside its "
            "range in the training records: a model must extrapolate there",
            0.35,
            f"a training record with input {given.name} over its whole range",
        )
        for given, count in zip(problem.inputs, seal.outside_inputs, strict=False)
        if count > 0.01 * sum(seal.lengths)
    ]
    return doubts


# Frequency responses of a problem's training records.


def check_period(records: Sequence[Trajectory], period: int | None) -> None:
    """Raise UserError where a record holds less than two periods."""
    for record in records:
        if period is not None and len(record) < 2 * period:
            raise UserError(
                f"data.period = {period}: record '{record.name}' has {len(record)} samples, "
                "expected two periods or more: correct it, or leave it out"
            )


def responses(problem: Problem) -> tuple[FrequencyResponse | None, ...]:
    """Return the frequency response of each output; None for an output with too little data, or
    samples that are not regular.

    A declared or detected period is used where there is one.
    """
    if problem.channels.time_step is not None:
        return (None,) * len(problem.outputs)
    period = problem.period or find_period(problem.train)
    return tuple(frequency_response(problem.train, k, period) for k in range(len(problem.outputs)))


def response_lines(problem: Problem) -> list[str]:
    """Describe the period, and noise and distortion of each output."""
    pairs = zip(problem.outputs, responses(problem), strict=True)
    found = [(signal.name, one) for signal, one in pairs if one is not None]
    lines = [f"output {name}: {_levels_text(one)}" for name, one in found]
    first = next((one for _, one in found if one.period is not None), None)
    if first is not None:
        records = len(problem.train)
        lines.insert(
            0,
            f"period ({'declared' if problem.period else 'found'}): {first.period} samples; "
            f"{first.periods} periods used of each of {records} record{'s' if records > 1 else ''}",
        )
    return lines


def _levels_text(found: FrequencyResponse) -> str:
    levels = found.levels
    if levels.noise is None:
        return (
            f"no period; noise and distortion together {_decibels(levels.both)} (squared coherence "
            f"{1.0 - levels.both**2:.3g})"
        )
    parts = {"odd distortion": levels.odd, "even distortion": levels.even}
    if levels.odd is None and levels.even is None:
        parts = {"distortion": levels.distortion}
    parts = {"noise": levels.noise, **parts}
    shown = ", ".join(f"{name} {_decibels(v)}" for name, v in parts.items() if v is not None)
    return f"{shown}; V cannot go below {levels.noise:.2g}"


def _decibels(level: float) -> str:
    return f"{20.0 * np.log10(level):.0f} dB" if level > 1e-10 else "none"
