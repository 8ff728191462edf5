"""Verdict on training records before a search: whether they suffice for a model, why, and which
experiment would help; with a proposed order and delay of a linear model.

Sources: Ljung, System Identification, 2nd ed., chapters 13 and 14 (experiment design, preparation
of data); Hjalmarsson, European Journal of Control 15, 2009.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from asia._statement import LEAST_FIT
from asia.data.statistics import delays, transfers
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.judge.evaluation.fold_fits import search_context
from asia.models._linear.fit import Refinement
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled, shortened
from asia.models.linear import Config, fit_records, select
from asia.problem.check import CheckReport, Doubt, input_delays, responses
from asia.problem.problem import Problem, prepared

Verdict = Literal["good", "usable with limits", "not enough"]
_NOT_ENOUGH, _LIMITS = 1.0, 0.3
_REASONS, _MOST_ORDER, _MOST_SAMPLES = 3, 6, 10_000
# Greatest number of channels for which a linear model is fitted in seconds.
_MOST_CHANNELS = 12
# Standard deviations of an output that a mode moves it by to count.
_MOVES = 0.1


@dataclass(frozen=True)
class LinearEvidence:
    """Order and delay that a linear model of the records needs: those of transfer functions whose
    errors are independent of the inputs, else those of state-space models of rising order."""

    order: int
    error: float
    """Simulation error, in standard deviations: on held-out blocks, or of the transfer functions.
    """
    order_errors: dict[int, float]
    """Those on held-out blocks by order; empty where transfer functions say the order."""
    delays: dict[str, int]
    """Samples before each input acts on an output, by name; inputs without an effect are left
    out."""
    time_constants: tuple[float, ...]
    """Those of the modes that move an output, in s, the slowest first; inf for one slower than the
    records."""
    sampling_time: float

    def lines(self) -> list[str]:
        """The proposal and its evidence as text."""
        step = self.sampling_time
        orders = ", ".join(f"{n}: {e:.2g}" for n, e in self.order_errors.items())
        times = ", ".join(
            f"{t:.3g} s" if math.isfinite(t) else "longer than the records"
            for t in self.time_constants
        )
        alone = len(self.delays) == 1
        counts = ", ".join(
            f"{d} sample{'' if d == 1 else 's'} ({d * step:g} s)" + ("" if alone else f" of {name}")
            for name, d in self.delays.items()
        )
        return [
            f"proposed  linear model of order {self.order}"
            + (f", delay {counts}" if counts else "")
            + (f", time constant{'s' * (len(self.time_constants) > 1)} {times}" if times else ""),
            f"evidence  error on inner held-out blocks, in standard deviations, by order: {orders}"
            if orders
            else f"evidence  a process model leaves {self.error:.2g} standard deviations, "
            "independent of the inputs",
        ]


@dataclass(frozen=True)
class DataVerdict:
    """Verdict on the records, its reasons and the proposed linear model."""

    verdict: Verdict
    reasons: tuple[str, ...]
    """The three that weigh most; where fewer limit the use, what speaks for the records."""
    experiment: str
    """The measurement that would help most; empty where nothing limits the use."""
    linear: LinearEvidence | None
    """None where no linear model could be fitted."""

    def lines(self) -> list[str]:
        """The verdict as text."""
        lines = [] if self.linear is None else self.linear.lines()
        lines += [f"verdict   {self.verdict}", *(f"reason    {one}" for one in self.reasons)]
        return lines + ([f"helps     {self.experiment}"] if self.experiment else [])


def judge_data(problem: Problem, report: CheckReport) -> DataVerdict:
    """Judge the training records by the findings of a check and by linear models of rising order.

    Args:
        problem: a loaded problem
        report: its check
    """
    doubts = list(report.doubts)
    doubts += [
        Doubt(str(one), 0.5, "a sensor that separates them, or a known value")
        for one in report.unidentifiable or ()
        if not one.has_priors
    ]
    merits: list[str] = []
    linear = _linear_evidence(problem)
    if linear is None:
        text = "the records are too short, or have too many channels, for a linear model"
        doubts.append(Doubt(text, 0.4))
    else:
        _judge_linear(problem, report, linear, doubts, merits)
    _judge_levels(problem, linear, doubts, merits)
    doubts.sort(key=lambda one: -one.weight)
    worst = doubts[0].weight if doubts else 0.0
    verdict: Verdict = (
        "not enough" if worst >= _NOT_ENOUGH else "usable with limits" if worst >= _LIMITS
        else "good"
    )  # fmt: skip
    heavy: list[Doubt] = []
    for one in doubts:
        # Findings that the same experiment would end are one reason.
        known = one.experiment and one.experiment in {other.experiment for other in heavy}
        if one.weight >= _LIMITS and not known and len(heavy) < _REASONS:
            heavy.append(one)
    reasons = [one.text for one in heavy] + merits[: _REASONS - len(heavy)]
    experiment = next((one.experiment for one in heavy if one.experiment), "")
    return DataVerdict(verdict, tuple(reasons), experiment, linear)


def _linear_evidence(problem: Problem) -> LinearEvidence | None:
    """Fit linear models to the training records; None where they are too short."""
    from scipy.signal import lfilter

    context, step = search_context(problem, 0), problem.sampling_time
    if context.nu + context.ny > _MOST_CHANNELS or context.nu == 0:
        return None
    train = prepared(problem, problem.train)
    known = _first_responses(problem, train)
    shown = {name: lag for name, lag in known.items() if lag is not None}
    fitted = [t for t in transfers(train) if t is not None and t.adequate and t.fit >= LEAST_FIT]
    if len(fitted) == context.ny:
        parts = [one for t in fitted for one in t.inputs if one is not None and one.acts]
        slow = [math.inf for one in parts if one.structure.integrator]
        lags = sorted((lag.value * step for one in parts for lag in one.lags), reverse=True)
        errors = [1.0 - t.fit / 100.0 for t in fitted]
        count, error = len(slow) + len(lags), sum(errors) / len(errors)
        return LinearEvidence(count, error, {}, shown, (*slow, *lags), step)
    records = scaled(_without_delays(train, list(known.values())), Scaling.of(train))
    config = Config(max_order=_MOST_ORDER, delay=0)
    try:
        chosen = select(records, context, config, Refinement())
        fixed = Config(order=chosen.order, delay=0)
        part = shortened(records, _MOST_SAMPLES, _MOST_SAMPLES // 10)
        system = fit_records(part, context, fixed, Refinement(iterations=20))[0].system
    except (UserError, ValueError, np.linalg.LinAlgError):
        return None
    if not all(map(math.isfinite, chosen.order_errors.values())):
        return None
    # Modes that move an output in these records: a small one may only follow drift.
    longest = max(records, key=len)
    poles, vectors = np.linalg.eig(system.a)
    into = np.linalg.lstsq(vectors, system.b.astype(complex), rcond=None)[0]
    times: list[float] = []
    for pole, b, c in zip(poles, into, (system.c @ vectors).T, strict=True):
        moved: Any = lfilter([0.0, 1.0], [1.0, -pole], longest.u @ b)
        size = abs(pole)
        if pole.imag >= 0 and size > 0 and float(np.abs(c).max() * moved.std()) > _MOVES:
            time = -1.0 / math.log(size) if size < 1 else math.inf
            times.append(time if time < len(longest) else math.inf)
    times.sort(reverse=True)
    order, errors = chosen.order, chosen.order_errors
    slow = tuple(t * step for t in times)
    return LinearEvidence(order, errors[order], errors, shown, slow, step)


def _first_responses(problem: Problem, records: Sequence[Trajectory]) -> dict[str, int | None]:
    """Samples until the first output responds to each input; None without an effect."""
    columns = zip(*delays(records), strict=True)
    lags = [[d.lag for d in column if d is not None and d.lag is not None] for column in columns]
    names = [signal.name for signal in problem.inputs]
    return {name: min(lag, default=None) for name, lag in zip(names, lags, strict=True)}


def _without_delays(records: Sequence[Trajectory], lags: Sequence[int | None]) -> list[Trajectory]:
    """Records whose inputs act in the next sample, from where all delayed inputs are known."""
    late = [max((lag or 1) - 1, 0) for lag in lags]
    longest = min(max(late, default=0), min(map(len, records)) // 2)
    found: list[Trajectory] = []
    for record in records:
        u = np.stack([np.roll(v, min(k, longest)) for v, k in zip(record.u.T, late, strict=True)])
        found.append(replace(record, u=u.T)[longest:])
    return found


def _judge_linear(
    problem: Problem,
    report: CheckReport,
    linear: LinearEvidence,
    doubts: list[Doubt],
    merits: list[str],
) -> None:
    """Compare the records with the dynamics of the linear model."""
    step, order = problem.sampling_time, linear.order
    lengths = [len(record) for record in problem.train]
    nu, ny = len(problem.inputs), len(problem.outputs)
    slowest = max(linear.time_constants, default=0.0)
    share = max(1.0 - linear.error**2, 0.0)
    if linear.error > 0.5:
        doubts.append(Doubt(
            f"a linear model explains {share:.0%} of the variance: the rest is noise or "
            "nonlinearity", 0.3 + 0.4 * (linear.error > 0.9), "two or more periods of the "
            "same input, which separate noise from nonlinearity",
        ))  # fmt: skip
    else:
        merits.append(
            f"a linear model of order {order} explains {share:.1%} of the variance"
            + (" of held-out samples" if linear.order_errors else "")
        )
    # 5 time constants settle a mode; a fit needs that several times.
    spans = max(lengths) * step / slowest if math.isfinite(slowest) and slowest > 0 else 0.0
    advice = f"records of {20 * slowest:.3g} s or more" if spans else "longer records"
    if spans == 0.0 and slowest > 0:
        doubts.append(Doubt(
            "the slowest mode is slower than the longest record: an integrator, or a record that "
            "is too short", 0.5, advice + ", or a record at rest after a step",
        ))  # fmt: skip
    elif slowest > 0 and spans < 20.0:
        doubts.append(Doubt(
            f"the longest record lasts {spans:.2g} times the slowest time constant, {slowest:.3g} "
            "s: its gain is not well determined", min(6.0 / spans, 0.9), advice,
        ))  # fmt: skip
    elif slowest > 0:
        merits.append(
            f"the longest record lasts {spans:.0f} times the slowest time constant, {slowest:.3g} s"
        )
    parameters = order * (nu + ny) + nu * ny
    samples = sum(lengths) * ny / parameters
    if samples < 60.0:
        doubts.append(Doubt(
            f"there are {samples:.0f} output samples for each parameter of a linear model",
            min(20.0 / samples, 1.5), "more records, or longer ones",
        ))  # fmt: skip
    else:
        merits.append(f"there are {samples:.0f} output samples for each parameter")
    if 0.0 < slowest < step:
        doubts.append(Doubt(
            f"the slowest time constant, {slowest:.3g} s, is shorter than the sampling time",
            0.6, f"a sampling time of {slowest / 10:.2g} s",
        ))  # fmt: skip
    for signal in report.signals:
        if signal.role != "input" or signal.constant:
            continue
        name = signal.signal.name
        if 4 <= signal.excitation_order < 2 * order:
            doubts.append(Doubt(
                f"input {name} excites at most {signal.excitation_order} modes, a linear model of "
                f"order {order} needs {2 * order}",
                1.0 if signal.excitation_order < order else 0.7,
                f"a random binary or multisine input on {name}",
            ))  # fmt: skip
        corner = 1.0 / (2.0 * math.pi * slowest) if slowest > 0 else 0.0
        if 0.0 < signal.bandwidth < 0.5 * corner:
            doubts.append(Doubt(
                f"input {name} has 99 % of its power below {signal.bandwidth:.2g} Hz, and the "
                f"slowest mode lies at {corner:.2g} Hz: the records show its gain, not its "
                "dynamics", 0.6, f"faster changes of {name}, up to {10 * corner:.2g} Hz",
            ))  # fmt: skip


def _judge_levels(
    problem: Problem,
    linear: LinearEvidence | None,
    doubts: list[Doubt],
    merits: list[str],
) -> None:
    """Judge effects of inputs, noise, amplitudes and lost samples."""
    delays = input_delays(problem)
    silent = bool(delays) and all(one.delay.lag is None for one in delays)
    if silent and linear is not None and linear.error > 0.9:
        doubts.append(Doubt(
            "no effect of an input on an output was found", 1.2,
            "larger and faster changes of the inputs",
        ))  # fmt: skip
    noise = [one.levels.noise for one in responses(problem) if one is not None]
    known = [level for level in noise if level is not None]
    if known and max(known) > 0.05:
        doubts.append(Doubt(
            f"noise is {max(known):.0%} of the standard deviation of an output: V cannot go below "
            f"{max(known):.2g}", min(3.0 * max(known), 1.5), "larger inputs, or more periods",
        ))  # fmt: skip
    elif known:
        merits.append(f"noise is {max(known):.1%} of the standard deviation of the outputs")
    u = np.concatenate([record.u for record in problem.train])
    binary = [s.name for s, v in zip(problem.inputs, u.T, strict=True) if len(np.unique(v)) == 2]
    if binary:
        doubts.append(Doubt(
            f"input {', '.join(binary)} has two values: a nonlinearity of it does not show", 0.35,
            f"several levels of {', '.join(binary)} over its whole range",
        ))  # fmt: skip
    y = np.concatenate([record.measured for record in problem.train])
    lost = float((~y).mean())
    if lost > 0.1:
        doubts.append(Doubt(f"{lost:.0%} of the output samples are missing", 0.25 + lost))
