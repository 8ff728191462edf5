"""Design of the next experiment: the input whose record reduces the uncertainty of the models most.

The model error of the output is a Gaussian process in units of the noise: its covariance between
two samples is the product of the differences of the models there (fold models, and candidates of
other families), and of the width of their error bands, times a kernel in the inputs and outputs
around the samples. So a difference seen in one place says little about another place. Changes of
physical parameters by their standard errors act everywhere. A record is judged by the uncertainty
that it leaves on reference inputs within the limits: the mean reduction of the entropy of their
outputs, and of that of the parameters (Bayesian D-optimality: Chaloner and Verdinelli, Statistical
Science 10, 1995; localised ensembles: Houtekamer and Mitchell, Monthly Weather Review 129, 2001).
Levels and switching times are sought by random changes of the best inputs so far, beginning with
amplitude-modulated binary sequences (APRBS) and multisines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from asia._progress import tracked
from asia.data.trajectory import Array, Signal, deviations, filled
from asia.errors import UserError
from asia.judge.evaluation.evaluator import Simulator
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.bands import error_sizes, output_bands
from asia.ledger.evidence import identified
from asia.ledger.run import Run, open_run
from asia.problem.identifiability import ParameterChanges
from asia.problem.load import load_lock
from asia.problem.memory import expanded
from asia.problem.problem import Problem
from asia.search.extension import leading_experiments
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import band_basis, fold_models, loading_stored_models

Predict: TypeAlias = Callable[[Array], Array]
"""Inputs (B, H, nu) -> simulations (M, B, H, ny), NaN where a model diverges."""
Reach: TypeAlias = Callable[[Array, Array], Array]
"""Inputs (H, nu) and simulation (H, ny) -> half width (H, ny) of the 99 % bands around it."""

# Mean square of the inputs, in half widths of their limits: that of uniform levels.
_ENERGY = 1.0 / 3.0
# Inputs of a generation, those that the next one changes, and shares of the way from the resting
# input to a start that are tried too.
_BATCH, _KEPT, _SMALLER = 32, 6, (1.0, 0.5, 0.2)
_HALVINGS = 14
# Standard deviation of an error in half widths of its 99 % band.
_DEVIATION = 0.39
# Moving averages of inputs, in rise times, beside which the input and the output themselves place a
# sample; samples of a record and of the references that count.
_AVERAGES, _MOST_SAMPLES = (1.0 / 3.0, 1.0, 3.0), 160
# Simulations whose way is so many times as long as that of the median of the models diverge.
_DIVERGED = 30.0
# Holding times of an APRBS and shortest period of a multisine, in rise times to 63 %.
_HELD, _SHORTEST_PERIOD = (0.5, 3.0), 2.0
_REFERENCES = ((0.5, 3.0), (1.0, 9.0), (0.2, 1.0))


@dataclass(frozen=True)
class InputLimits:
    """Limits of the inputs, and the input before the record."""

    low: Array
    """(nu,)"""
    high: Array
    step: Array
    """Largest change (nu,) from sample to sample; infinite for none."""
    rest: Array
    """Input (nu,) at which the record starts."""

    def energy(self, u: Array) -> Array:
        """Mean square (B,) of inputs (B, H, nu) around the middle of their limits, in half
        widths."""
        half = 0.5 * (self.high - self.low)
        return (((u - 0.5 * (self.low + self.high)) / half) ** 2).mean(axis=(1, 2))

    def scaled(self, u: Array, energy: float, *, equal: bool = False) -> Array:
        """Inputs (B, H, nu) within the limits, moved towards or away from the middle so that their
        energy is at most this, or equal to it."""
        middle = 0.5 * (self.low + self.high)

        def moved(factor: Array) -> Array:
            away = middle + factor[:, None, None] * (u - middle)
            return self.slewed(np.clip(away, self.low, self.high))

        low, high = np.zeros(len(u)), np.full(len(u), 50.0 if equal else 1.0)
        enough = self.energy(moved(high)) <= energy
        for _ in range(0 if enough.all() else _HALVINGS):
            half = 0.5 * (low + high)
            more = self.energy(moved(half)) > energy
            low, high = np.where(more, low, half), np.where(more, half, high)
        return moved(np.where(enough, 50.0 if equal else 1.0, low))

    def slewed(self, u: Array) -> Array:
        """Inputs (B, H, nu) whose changes are limited."""
        if not np.isfinite(self.step).any():
            return u
        found, last = np.empty_like(u), np.broadcast_to(self.rest, u[:, 0].shape)
        for k in range(u.shape[1]):
            last = last + np.clip(u[:, k] - last, -self.step, self.step)
            found[:, k] = last
        return found


@dataclass(frozen=True)
class Subject:
    """Models, noise and limits of a design."""

    predict: Predict
    members: tuple[int, ...]
    """Candidate that each model belongs to; the models of the best candidate come first."""
    errors: Mapping[int, float]
    """V of each candidate."""
    noise: Array
    """Standard deviation (ny,) of the measurement noise."""
    limits: InputLimits
    keep: Array
    """Least and largest permitted output, (2, ny); infinite for none."""
    reach: Reach
    changes: Predict | None = None
    """Changes (P, B, H, ny) of the output by independent changes of the parameters, each by its
    standard error; None without parameters."""


@dataclass(frozen=True)
class Judged:
    """An input and what is expected of it."""

    u: Array
    """(H, nu)"""
    y: Array
    """Simulations (M, H, ny)."""
    lower: Array
    """Least expected output (H, ny)."""
    upper: Array
    gain: float
    """Mean reduction of the entropy of a sample of the references, in nats, and of that of a
    parameter."""
    left: float
    """Expected error of the models on the references after the record, root mean square in units
    of the noise."""
    excess: float
    """Mean excess of the expected outputs over what is permitted, in units of the noise; 0 where
    all limits hold."""

    @property
    def rank(self) -> tuple[bool, float]:
        """Higher is better: inputs that hold the limits first."""
        holds = self.excess == 0.0
        return holds, self.gain if holds else -self.excess


@dataclass(frozen=True)
class _Uncertainty:
    """Model error at samples of one input, as a Gaussian process in units of the noise."""

    place: Array
    """(N, features)"""
    local: Array
    """(L, N, ny): differences and errors that are alike at near places only."""
    everywhere: Array
    """(P, N, ny): those by parameters."""

    def covariance(self, other: _Uncertainty, output: int) -> Array:
        """(N, N of the other)."""
        a, b = self.place, other.place
        apart = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        local = self.local[..., output].T @ other.local[..., output]
        found = np.exp(-0.5 * apart / a.shape[1]) * local
        return found + self.everywhere[..., output].T @ other.everywhere[..., output]

    def variance(self) -> Array:
        """(N, ny)"""
        return (self.local**2).sum(axis=0) + (self.everywhere**2).sum(axis=0)


class Judge:
    """Judges inputs of one length by the uncertainty that remains on reference inputs."""

    def __init__(self, subject: Subject, samples: int, rise: float) -> None:
        """Raise UserError where all models diverge on the references."""
        self.subject, self._rise = subject, rise
        limits, rng = subject.limits, np.random.default_rng(1)
        steps = [aprbs(rng, samples, limits, a * rise, b * rise) for a, b in _REFERENCES]
        waves = [multisine(rng, samples, limits, period * rise) for period in (2.0, 1.0)]
        inputs = limits.slewed(np.stack([*steps, *waves]))
        y = subject.predict(inputs)
        # Ways of a model that diverges count as infinite.
        with np.errstate(invalid="ignore"):
            way = np.nan_to_num(np.abs(y - y[:, :, :1]), nan=np.inf).max(axis=(2, 3))
        diverges = ~(way < _DIVERGED * np.sort(way, axis=0)[(len(way) - 1) // 2])
        self.usable = np.flatnonzero(diverges.mean(axis=1) < 0.5)
        if not len(self.usable):
            raise UserError(
                "all models diverge on inputs within the limits: give narrower --limits"
            )
        members = np.array(subject.members)[self.usable]
        base = members == members[0]
        self._base, count = np.flatnonzero(base), int(base.sum())
        self._contrasts = np.eye(len(members)) - base / count
        other = np.array([subject.errors[int(n)] for n in members])
        weight = subject.errors[int(members[0])] / np.maximum(other, 1e-300)
        weight[base] = math.sqrt(max(count - 1, 0) / count)
        self._contrasts *= weight[:, None]
        good = ~diverges[self.usable].any(axis=0)
        if not good.any():
            raise UserError(
                "the models diverge on inputs within the limits: give narrower --limits"
            )
        inputs, y = inputs[good], y[self.usable][:, good]
        places = np.concatenate(self._places(inputs, y))
        self._scale = deviations(places)
        every = -(-len(places) // _MOST_SAMPLES)
        changes = self._changes(inputs)
        parts = [self._uncertainty(u, y[:, k], changes[:, k], every) for k, u in enumerate(inputs)]
        centre = np.concatenate(
            [y[self._base, k].mean(axis=0)[::every] for k in range(len(inputs))]
        )
        # Outputs that are not permitted need no model.
        permitted = (centre >= subject.keep[0]) & (centre <= subject.keep[1])
        inside = np.flatnonzero(np.all(permitted, axis=1))
        if len(inside) < 0.1 * len(centre):
            inside = np.arange(len(centre))
        self._reference = _Uncertainty(
            np.concatenate([one.place for one in parts])[inside],
            np.concatenate([one.local for one in parts], axis=1)[:, inside],
            np.concatenate([one.everywhere for one in parts], axis=1)[:, inside],
        )
        self.before = float(np.sqrt(self._reference.variance().mean()))

    def _places(self, inputs: Array, y: Array) -> list[Array]:
        """Features (H, features) of the samples of inputs (B, H, nu): input, moving averages of it,
        simulated output."""
        limits = self.subject.limits
        u = (inputs - limits.rest) / (limits.high - limits.low)
        columns = [u]
        for share in _AVERAGES:
            length = max(round(share * self._rise), 1)
            padded = np.concatenate([np.zeros((len(u), length, u.shape[2])), u], axis=1)
            total = np.cumsum(padded, axis=1)
            columns.append((total[:, length:] - total[:, :-length]) / length)
        return list(np.concatenate([*columns, y[self._base].mean(axis=0)], axis=2))

    def _changes(self, inputs: Array) -> Array:
        """Changes (P, B, H, ny) by the parameters."""
        if self.subject.changes is None:
            return np.zeros((0, *inputs.shape[:2], len(self.subject.noise)))
        return self.subject.changes(inputs)

    def _uncertainty(self, u: Array, y: Array, changes: Array, every: int) -> _Uncertainty:
        """Uncertainty at each `every`-th sample of an input (H, nu)."""
        subject = self.subject
        (place,) = self._places(u[None], y[:, None])
        apart = np.einsum("rm,mho->rho", self._contrasts, y)
        error = _DEVIATION * subject.reach(u, y[self._base].mean(axis=0))
        local = np.concatenate([apart, error[None]]) / subject.noise
        everywhere = changes / subject.noise
        return _Uncertainty(place[::every] / self._scale, local[:, ::every], everywhere[:, ::every])

    def __call__(self, inputs: Array) -> list[Judged]:
        """Simulate inputs (B, H, nu) with all models, and judge them."""
        subject, reference = self.subject, self._reference
        simulated = subject.predict(inputs)[self.usable]
        every = -(-inputs.shape[1] // _MOST_SAMPLES)
        before, changes = reference.variance(), self._changes(inputs)
        both = np.concatenate([simulated, changes])
        failed: Any = ~np.isfinite(both).all(axis=(0, 2, 3))
        found: list[Judged] = []
        for k, u in enumerate(inputs):
            y = simulated[:, k]
            if failed[k]:
                nothing = np.full(y.shape[1:], np.nan)
                found.append(Judged(u, y, nothing, nothing, 0.0, self.before, np.inf))
                continue
            record = self._uncertainty(u, y, changes[:, k], every)
            after = np.empty_like(before)
            for i in range(y.shape[2]):
                own = record.covariance(record, i)
                # Rounding of large entries must not make it indefinite.
                noise = 1.0 + 1e-12 * np.trace(own)
                root = np.linalg.cholesky(own + noise * np.eye(len(own)))
                seen = np.linalg.solve(root, record.covariance(reference, i))
                after[:, i] = np.maximum(before[:, i] - (seen**2).sum(axis=0), 0.0)
            gain = 0.5 * float(np.mean(np.log1p(before) - np.log1p(after)))
            if len(record.everywhere):
                z = record.everywhere.reshape(len(record.everywhere), -1)
                gain += 0.5 * float(np.linalg.slogdet(np.eye(len(z)) + every * z @ z.T)[1]) / len(z)
            wide = subject.reach(u, y[self._base].mean(axis=0))
            lower, upper = y.min(axis=0) - wide, y.max(axis=0) + wide
            over = np.maximum(np.maximum(upper - subject.keep[1], subject.keep[0] - lower), 0.0)
            excess = float((over / subject.noise).mean())
            left = float(np.sqrt(after.mean()))
            found.append(Judged(u, y, lower, upper, gain, left, excess))
        return found


def aprbs(
    rng: np.random.Generator, samples: int, limits: InputLimits, shortest: float, longest: float
) -> Array:
    """Uniform levels (H, nu) within the limits, each held for a random number of samples."""
    columns: list[Array] = []
    for low, high in zip(limits.low, limits.high, strict=True):
        values: list[float] = []
        while len(values) < samples:
            hold = int(rng.uniform(max(shortest, 1.0), max(longest, 1.0) + 1.0))
            values += [float(rng.uniform(low, high))] * hold
        columns.append(np.array(values[:samples]))
    return np.stack(columns, axis=1)


def multisine(
    rng: np.random.Generator, samples: int, limits: InputLimits, shortest_period: float
) -> Array:
    """Random-phase multisine (H, nu), flat up to a shortest period in samples, as large as the
    limits allow."""
    lines = np.arange(1, max(int(samples / max(shortest_period, 2.0)), 3) + 1)
    turns = np.arange(samples)[:, None] * lines / samples
    columns = [
        np.cos(2.0 * np.pi * (turns + rng.uniform(size=len(lines)))).sum(axis=1) for _ in limits.low
    ]
    u = np.stack(columns, axis=1)
    return 0.5 * (limits.low + limits.high) + 0.5 * (limits.high - limits.low) * u / np.abs(u).max(
        axis=0
    )


def rise_samples(subject: Subject, samples: int) -> float:
    """Samples in which the output of the first model makes 63 % of its way after a step of an input
    by a quarter of its limits, the longest of all outputs; a 20th of the record where it moves
    slower than that."""
    limits, found = subject.limits, 1.0
    for j in range(len(limits.low)):
        u = np.tile(limits.rest, (2, samples, 1))
        room = limits.high[j] - limits.rest[j] > limits.rest[j] - limits.low[j]
        u[1, :, j] += (0.25 if room else -0.25) * (limits.high[j] - limits.low[j])
        still, moved = subject.predict(u)[0]
        with np.errstate(invalid="ignore"):
            way = np.abs(moved - still)
        rounding = 1e-9 * np.abs(still).max(axis=0)
        for column, least in zip(way.T, rounding, strict=True):
            if np.isfinite(column).all() and column[-1] > least:
                at = float(np.argmax(column >= 0.63 * column[-1]))
                found = max(found, min(at, samples / 20.0))
    return found


@dataclass(frozen=True)
class NextExperiment:
    """A proposed input beside an APRBS and a multisine of equal energy."""

    proposed: Judged
    aprbs: Judged
    multisine: Judged
    limits: InputLimits
    before: float
    """Expected error of the models on the references now, in units of the noise."""
    members: tuple[int, ...]
    """Candidate of each model that does not diverge within the limits."""
    energy: float
    """Mean square of the input around the middle of its limits, in half widths."""
    rise: float
    """Samples to 63 % of a step response."""


def design_experiment(
    subject: Subject, samples: int, *, seed: int = 0, generations: int = 30
) -> NextExperiment:
    """Search for the input of the largest gain that holds the limits.

    Args:
        samples: length of the record
        generations: of 32 inputs each

    Raises:
        UserError: where all models diverge within the limits
    """
    rng, limits = np.random.default_rng(seed), subject.limits
    rise = rise_samples(subject, samples)
    judge = Judge(subject, samples, rise)
    held, period = (_HELD[0] * rise, _HELD[1] * rise), _SHORTEST_PERIOD * rise

    def rivals() -> Array:
        pair = [aprbs(rng, samples, limits, *held), multisine(rng, samples, limits, period)]
        return np.stack(pair)

    first = rivals()
    starts = [first, *(rivals() for _ in range(3))]
    for share in (0.3, 1.0, 3.0):
        starts.append(aprbs(rng, samples, limits, share * held[0], share * held[1])[None])
    whole = np.concatenate(starts)
    smaller = [limits.rest + share * (whole - limits.rest) for share in _SMALLER]
    best = judge(limits.scaled(np.concatenate(smaller)[:_BATCH], _ENERGY))
    for _ in tracked(range(generations), "generation"):
        best = sorted(best, key=lambda one: one.rank, reverse=True)[:_KEPT]
        children = np.stack([_changed(rng, best, limits, rise) for _ in range(_BATCH)])
        best += judge(limits.scaled(children, _ENERGY))
    proposed = max(best, key=lambda one: one.rank)
    energy = float(limits.energy(proposed.u[None])[0])
    others = judge(limits.scaled(first, energy, equal=True))
    members = tuple(subject.members[k] for k in judge.usable)
    return NextExperiment(
        proposed, others[0], others[1], limits, judge.before, members, energy, rise
    )


def _changed(
    rng: np.random.Generator, best: list[Judged], limits: InputLimits, rise: float
) -> Array:
    """A changed copy of one of the inputs: other levels, other switching times, a part of another
    input, or another size."""
    u = best[int(rng.integers(len(best)))].u.copy()
    samples, width = len(u), limits.high - limits.low
    for _ in range(int(rng.integers(1, 4))):
        j = int(rng.integers(u.shape[1]))
        length = int(np.clip(rise * np.exp(rng.uniform(-1.5, 2.0)), 1, samples))
        start = int(rng.integers(-length + 1, samples))
        part = slice(max(start, 0), min(start + length, samples))
        kind = rng.random()
        if kind < 0.35:
            u[part, j] = rng.uniform(limits.low[j], limits.high[j])
        elif kind < 0.6:
            u[part, j] += 0.2 * width[j] * rng.standard_normal()
        elif kind < 0.75:
            # The level before the part, or the one behind it, lasts longer.
            edge = part.start - 1 if rng.random() < 0.5 else part.stop
            u[part, j] = u[min(max(edge, 0), samples - 1), j]
        elif kind < 0.9:
            u[part] = best[int(rng.integers(len(best)))].u[part]
        else:
            u = limits.rest + np.exp(0.2 * rng.standard_normal()) * (u - limits.rest)
    return u


# The models of a run.

# Coverage of the bands that limits of outputs are held with; other families beside the best, and
# how much larger their V may be.
_LEVEL, _OTHERS, _FAR = 0.99, 3, 4.0
# Samples in which the output must come to rest, at least, and how much it may still move, in
# standard deviations.
_SETTLE, _STILL = 500, 0.02


@dataclass(frozen=True)
class LearnedParameter:
    """A parameter with its standard error now, and as expected after a record."""

    name: str
    value: float
    now: float
    proposed: float
    aprbs: float
    multisine: float


@dataclass(frozen=True)
class RunExperiment:
    """The next experiment of a run."""

    run: str
    inputs: tuple[Signal, ...]
    """Planned inputs, without disturbances."""
    outputs: tuple[Signal, ...]
    sampling_time: float
    """Sampling time of the models in s."""
    found: NextExperiment
    noise: Array
    """(ny,)"""
    rest: tuple[Array, Array]
    """Input (nu,) and output (ny,) before the record."""
    disturbances: tuple[tuple[Signal, float], ...]
    """Inputs that the plan does not set, each with the value at which it is held."""
    parameters: tuple[LearnedParameter, ...]
    notes: tuple[str, ...]


def next_experiment(
    directory: Path,
    seconds: float,
    limits: Mapping[str, tuple[float, float]],
    rate: Mapping[str, float],
    keep: Mapping[str, tuple[float, float]],
    *,
    start: Mapping[str, float] | None = None,
    seed: int = 0,
    isolation: Isolation | None = None,
) -> RunExperiment:
    """Design the next experiment for the models of a run: the fold models of the best candidate and
    of the best ones of other families.

    Args:
        directory: folder of the run
        limits: least and largest value of inputs; those of the records where there are none
        rate: largest change of inputs in a second
        keep: limits of outputs
        start: inputs before the record; the means of the training records where there are none,
            which a disturbance keeps
        isolation: level of the candidates; None for the strongest of this machine

    Raises:
        UserError: for limits and times that make no record, and models that cannot be simulated
    """
    run = open_run(directory)
    problem, view = load_lock(run.directory / LOCK), run.view
    best = view.best
    if best is None or best.score is None:
        raise UserError(f"run '{run.name}' has no scored model")
    samples = round(seconds / problem.sampling_time)
    least = 4 * problem.protocol.past
    if samples < least:
        raise UserError(
            f"--duration is {seconds:g} s, which is {samples} samples: expected at least {least}"
        )
    evaluator = make_evaluator(problem, view, isolation=isolation)
    records = evaluator.data.records
    every = np.concatenate([record.u for record in records])
    actuated = [j for j, signal in enumerate(problem.inputs) if signal.is_actuated]
    if not actuated:
        raise UserError("all inputs are disturbances: there is nothing to plan")
    inputs = tuple(problem.inputs[j] for j in actuated)
    names = [signal.name for signal in inputs]
    ends = np.array(
        [limits.get(n, (a.min(), a.max())) for n, a in zip(names, every.T[actuated], strict=True)]
    )
    given = start or {}
    means = zip(problem.inputs, every.mean(axis=0).tolist(), strict=True)
    rest: Array = np.array([given.get(signal.name, mean) for signal, mean in means])
    begin = rest[actuated]
    others = tuple(
        (s, float(v)) for s, v in zip(problem.inputs, rest, strict=True) if not s.is_actuated
    )
    if not ((ends[:, 0] <= begin) & (begin <= ends[:, 1])).all():
        raise UserError(
            f"the record begins at {begin.tolist()}, outside the limits {ends.tolist()}: give "
            "wider --limits or another --start"
        )
    step = np.array([rate.get(name, np.inf) for name in names]) * problem.sampling_time
    kept = np.array([keep.get(signal.name, (-np.inf, np.inf)) for signal in problem.outputs]).T

    leading = leading_experiments(view, 1 + _OTHERS, _FAR)
    members = [
        (run.store.text(e.source), [run.store.get(m) for m in fold_models(e).models])
        for e in leading
    ]
    numbers = [e.number for e, (_, m) in zip(leading, members, strict=True) for _ in m]
    folds = len(members[0][1])
    values = {e.number: e.score.value for e in leading if e.score is not None}

    basis = band_basis(evaluator, view, run.store, "ensemble")
    spread = evaluator.data.scale
    noise = np.maximum(basis.noise, 1e-6 * spread)
    zero = np.zeros((len(basis.errors), 1, len(spread)))
    reach = output_bands(error_sizes(basis.errors), zero, _LEVEL).upper
    rule, done = problem.protocol, problem.preprocess
    before = rule.past_inputs * done.decimate + done.longest_delay

    def design(simulate: Simulator) -> RunExperiment:
        last = records[-1]
        settle = max(_SETTLE, max(map(len, records)))
        held = np.tile(rest, (1, settle, 1))
        window = (
            last.u[len(last) - rule.past_inputs :],
            filled(last.y)[len(last) - rule.past_outputs :],
        )
        y = simulate(window[0][None], window[1][None], held)[:folds, 0].mean(axis=0)
        still = np.abs(y[-1] - y[int(0.8 * settle)]) <= _STILL * spread
        if not (np.isfinite(y).all() and still.all()):
            raise UserError(
                f"the model does not come to rest at the inputs {rest.tolist()}: choose another "
                "--start"
            )
        at_rest = y[-1]
        past_y = np.tile(at_rest, (rule.past_outputs, 1))

        def beside(u: Array) -> Array:
            """All inputs (..., nu): the planned ones, and disturbances at rest."""
            every = np.tile(rest, (*u.shape[:-1], 1))
            every[..., actuated] = u
            return every

        def seen(planned: Array) -> tuple[Array, Array]:
            """Past inputs and inputs as a model reads them, of planned inputs behind the rest."""
            u = beside(planned)
            raw = np.concatenate([np.tile(rest, (before, 1)), np.repeat(u, done.decimate, axis=0)])
            whole = done.inputs(raw, problem.inputs) if done else raw
            return whole[: rule.past_inputs], whole[rule.past_inputs :]

        def predict(u: Array) -> Array:
            # One number of cases: a model is compiled once.
            pairs = [seen(one) for one in (*u, *([u[0]] * (-len(u) % _BATCH)))]
            past_u, inputs = (np.stack(side) for side in zip(*pairs, strict=True))
            return simulate(past_u, np.tile(past_y, (len(inputs), 1, 1)), inputs)[:, : len(u)]

        def wide(u: Array, y: Array) -> Array:
            return reach * np.maximum(basis.region.distance(*seen(u), y), 1.0)[:, None]

        own = InputLimits(ends[:, 0], ends[:, 1], step, begin)
        identify = _parameters(run, problem, (rest, at_rest), beside)
        subject = Subject(
            predict, tuple(numbers), values, noise, own, kept, wide,
            None if identify is None else identify.changes,
        )  # fmt: skip
        found = design_experiment(subject, samples, seed=seed)
        gained = () if identify is None else identify.gained(found, noise)
        return RunExperiment(
            run.name, inputs, problem.outputs, problem.sampling_time, found, noise,
            (begin, at_rest), others, gained,
            tuple(
                f"models of #{n:02d} diverge within the limits and are left out"
                for n in values if found.members.count(n) < numbers.count(n)
            ),
        )  # fmt: skip

    with loading_stored_models(view):
        return evaluator.models.with_simulators(members, design)


@dataclass(frozen=True)
class _Parameters:
    """Parameters of the equations, whose errors have this covariance."""

    names: tuple[str, ...]
    values: Array
    root: Array
    """(q, p): its rows are independent changes of a standard error each."""
    changes: Predict

    def gained(self, found: NextExperiment, noise: Array) -> tuple[LearnedParameter, ...]:
        """Standard errors now and after each record."""
        after: list[Array] = [np.sqrt((self.root**2).sum(axis=0))]
        for one in (found.proposed, found.aprbs, found.multisine):
            z = (self.changes(one.u[None])[:, 0] / noise).reshape(len(self.root), -1)
            left = np.linalg.solve(np.eye(len(z)) + z @ z.T, self.root)
            after.append(np.sqrt(np.maximum((self.root * left).sum(axis=0), 0.0)))
        return tuple(
            LearnedParameter(name, float(value), *map(float, errors))
            for name, value, errors in zip(self.names, self.values, np.stack(after, 1), strict=True)
        )


def _parameters(
    run: Run, problem: Problem, rest: tuple[Array, Array], beside: Callable[[Array], Array]
) -> _Parameters | None:
    """The parameters of the equations as the best candidate identified them; None where it names no
    standard errors of them."""
    found, physics = identified(run), problem.physics
    if found is None or physics is None:
        return None
    if expanded(physics, [s.name for s in problem.outputs]).delays:
        return None
    rows = [(k, one.fitted) for k, one in enumerate(found.parameters)]
    rows = [(k, one) for k, one in rows if one.name in physics.parameters]
    if {one.name for _, one in rows} != set(physics.parameters):
        return None
    order = {one.name: (k, one) for k, one in rows}
    chosen = [order[name] for name in physics.parameters]
    if any(one.standard_error is None for _, one in chosen):
        return None
    errors = np.array([one.standard_error for _, one in chosen], np.float64)
    places = [k for k, _ in chosen]
    correlation = np.array(found.correlation, np.float64)[np.ix_(places, places)]
    correlation = np.where(np.isfinite(correlation), correlation, np.eye(len(places)))
    sizes, vectors = np.linalg.eigh(correlation)
    root = (np.sqrt(np.maximum(sizes, 0.0))[:, None] * vectors.T) * errors
    values = {one.name: one.value for _, one in chosen}
    signals = [s.name for s in problem.inputs], [s.name for s in problem.outputs]

    by_equations = ParameterChanges(physics, signals, values, root, rest, problem.sampling_time)

    def changes(u: Array) -> Array:
        return np.nan_to_num(by_equations(beside(u)), nan=0.0, posinf=0.0, neginf=0.0)

    return _Parameters(tuple(values), np.array(list(values.values())), root, changes)
