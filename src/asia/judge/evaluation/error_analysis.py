"""Analysis of the error of a fitted candidate: its parts, and the terms that would explain it.

A model with `initial` and `step` is simulated with changed states, all changes as one batch. So the
response of the outputs to a force on a state is exact at the current fit, whatever the model is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from asia.candidate import Context, Model, StepModel
from asia.data.segment import Segment, SimulatedSegment, stacked
from asia.data.trajectory import Array, Trajectory, filled, is_constant, spread_of
from asia.judge.evaluation.requests import spread
from asia.judge.scoring.checks.residual import explained
from asia.lowering.linear import LinearModel
from asia.models.methods import LevenbergMarquardt
from asia.problem.folds import whole
from asia.problem.protocol import ProtocolRule

# Samples of a fold that are analysed, states of a model, and Gauss-Newton steps.
_MOST_SAMPLES, _MOST_STATES, _ITERATIONS = 3000, 40, 8
_SMALL = 1e-4
"""Size of a change for a derivative, in standard deviations of the state."""
_DELAYS = (1, 2, 4, 8, 16)


@dataclass(frozen=True)
class Rollout:
    """A batch of simulations."""

    states: Array
    """State at each sample and after the last one, (H + 1, B, n): all floating-point numbers of the
    tree of states. The first one alone where a force acts."""
    y: Array
    """Outputs (H, B, ny)."""


def _repeated(batch: SimulatedSegment, times: int) -> SimulatedSegment:
    """The whole batch several times, one after the other."""
    parts = {
        name: np.concatenate([getattr(batch, name)] * times)
        for name in ("past_u", "past_y", "u", "y", "y_hat")
    }
    return replace(batch, **parts)


def _places(blocks: Sequence[Segment], length: int, *, first: bool) -> tuple[tuple[int, int], ...]:
    """Block and first sample of windows of a length, evenly spread, `_MOST_SAMPLES` samples
    together; first: only the first window of each block, which starts as the evaluator's simulation
    does."""
    places = [
        (i, k)
        for i, block in enumerate(blocks)
        for k in range(0, 1 if first else len(block.y) - length + 1, length)
    ]
    return spread(places, max(1, _MOST_SAMPLES // length))


def windows(
    blocks: Sequence[Segment], y_hat: Sequence[Array], length: int, *, first: bool = False
) -> SimulatedSegment:
    """Cut blocks into a batch of windows, chosen as by `_places`, on straight lines where no output
    was measured."""
    each = [block.simulated(y) for block, y in zip(blocks, y_hat, strict=True)]
    each = [replace(one, y=one.complete_y) for one in each]
    places = _places(blocks, length, first=first)
    return stacked([each[i].part(k, k + length) for i, k in places])


def _earlier_inputs(blocks: Sequence[Segment], length: int, *, first: bool) -> Array:
    """Inputs (B, 16, nu) before the windows of `_places`, the first one held where the record
    begins."""
    before: list[Array] = []
    for i, k in _places(blocks, length, first=first):
        u = np.concatenate([blocks[i].past_u, blocks[i].u])
        stop = k + len(blocks[i].past_u)
        rows = np.arange(stop - _DELAYS[-1], stop)
        before.append(u[np.maximum(rows, 0)])
    return np.stack(before)


def rollout(
    model: StepModel,
    of: SimulatedSegment,
    start: Array | None = None,
    force: Array | None = None,
    direction: Array | None = None,
) -> Rollout:
    """Simulate a batch.

    Args:
        start: initial states (B, n) in place of those of the model
        force: (H, B), added to each next state along `direction`
        direction: (B, n)
    """
    import jax  # only to take trees of states apart

    batch = len(of.u)
    leaves, tree = jax.tree.flatten(model.initial(of.past_u, of.past_y, of.u[:, 0]))

    def vector(leaves: Sequence[Any]) -> Array:
        parts = [np.asarray(x, np.float64).reshape(batch, -1) for x in leaves if _floating(x)]
        return np.concatenate(parts, axis=1) if parts else np.zeros((batch, 0))

    def with_vector(leaves: Sequence[Any], x: Array) -> list[Any]:
        found, place = list[Any](), 0
        for leaf in leaves:
            size = int(np.prod(np.shape(leaf)[1:])) if _floating(leaf) else 0
            part = x[:, place : place + size]
            found.append(part.reshape(np.shape(leaf)) if _floating(leaf) else leaf)
            place += size
        return found

    if start is not None:
        leaves = with_vector(leaves, start)
    states, outputs = [vector(leaves)], list[Array]()
    for k in range(of.u.shape[1]):
        state, y = model.step(jax.tree.unflatten(tree, leaves), of.u[:, k])
        leaves = jax.tree.leaves(state)
        if force is not None and direction is not None:
            leaves = with_vector(leaves, vector(leaves) + force[k][:, None] * direction)
        if force is None:
            states.append(vector(leaves))
        outputs.append(np.asarray(y, np.float64))
    return Rollout(np.stack(states), np.stack(outputs))


def _floating(leaf: Any) -> bool:
    return np.issubdtype(np.asarray(leaf).dtype, np.floating)


def _sizes(states: Array) -> Array:
    """Typical change (n,) of each state in (H, B, n); 0 for one that stays at zero."""
    flat = states.reshape(-1, states.shape[-1])
    still = [is_constant(x) for x in flat.T]
    return np.where(still, 1e-2 * np.abs(flat).max(axis=0, initial=0.0), flat.std(axis=0))


@dataclass(frozen=True)
class _Started:
    """Simulations from the initial states with the smallest squared error."""

    free: Rollout
    """From the initial states of the model."""
    best: Rollout
    slopes: Array
    """Change of the outputs (B, H * ny, n) of `best` for a change of each initial state by `size`,
    divided by the scale."""
    size: Array
    """Typical change (n,) of each state."""


def _best_starts(model: StepModel, of: SimulatedSegment, scale: Array) -> _Started | None:
    """Fit the initial state of each window by Gauss-Newton steps; None for a model without a state
    that can be changed."""
    free = best = rollout(model, of)
    n, batch = free.states.shape[2], len(of.u)
    size = _sizes(free.states)
    if not 0 < n <= _MOST_STATES or not size.any() or not np.isfinite(free.y).all():
        return None
    changed = _repeated(of, n)
    slopes, steps = np.zeros((batch, of.y[0].size, n)), 0.5 ** np.arange(4)
    tried_windows = _repeated(of, len(steps))
    squares = _squares(best, of, scale)
    for more in range(_ITERATIONS + 1):
        start = best.states[0] + _SMALL * np.repeat(np.diag(size), batch, 0).reshape(n, batch, n)
        moved = rollout(model, changed, start.reshape(n * batch, n)).y
        moved = (moved.reshape(len(moved), n, batch, -1) - best.y[:, None]) / (_SMALL * scale)
        slopes = np.nan_to_num(moved.transpose(2, 0, 3, 1).reshape(batch, -1, n))
        if more == _ITERATIONS:
            break
        e = ((of.y - best.y.transpose(1, 0, 2)) / scale).reshape(batch, -1)
        move = np.stack([_kept(j)[1].T @ e_b for j, e_b in zip(slopes, e, strict=True)]) * size
        tried = best.states[0] + steps[:, None, None] * move
        found = rollout(model, tried_windows, tried.reshape(-1, n))
        each = _squares(found, tried_windows, scale).reshape(len(steps), batch)
        place = np.argmin(each, axis=0)
        lower = each[place, np.arange(batch)] < squares
        pick = np.where(lower, place * batch + np.arange(batch), 0)
        gained = float(np.sum(squares - np.where(lower, each[place, np.arange(batch)], squares)))
        best = Rollout(
            np.where(lower[:, None], found.states[:, pick], best.states),
            np.where(lower[:, None], found.y[:, pick], best.y),
        )
        squares = _squares(best, of, scale)
        if gained < 1e-3 * float(squares.sum()):
            break
    return _Started(free, best, slopes, size)


def _rank(slopes: Array, values: Array | None = None) -> int:
    """Number of directions of an initial state that matter, at most one for each four samples."""
    found = np.linalg.svd(slopes, compute_uv=False) if values is None else values
    return min(int(np.sum(found > 1e-3 * max(found[0], 1e-300))), max(1, len(slopes) // 4))


def _kept(slopes: Array) -> tuple[Array, Array]:
    """Orthonormal slopes (H * ny, r) of these directions, and their pseudo-inverse, transposed."""
    left, values, right = np.linalg.svd(slopes, full_matrices=False)
    many = _rank(slopes, values)
    return left[:, :many], (left[:, :many] / np.maximum(values[:many], 1e-300)) @ right[:many]


def _squares(found: Rollout, of: SimulatedSegment, scale: Array) -> Array:
    """Sum of squared errors (B,), infinite where a simulation diverges."""
    e = (of.y - found.y.transpose(1, 0, 2)) / scale
    return np.nan_to_num(np.sum(e**2, axis=(1, 2)), nan=np.inf)


# The parts of the error, and its course.


@dataclass(frozen=True)
class ErrorParts:
    """Shares of the squared error of held-out blocks; they add up to 1."""

    initial_state: float | None
    """Share that the best initial state removes; None for a model that cannot be changed."""
    slow: float
    """Share of what is left that is slower than two periods in a block: an offset, a drift."""
    dynamics: float
    """The rest."""
    over_time: Array
    """RMS error in ten parts of the blocks, in standard deviations of the outputs."""
    frequencies: Array
    """Edges of the bands, Hz (bands + 1,); the first is 0."""
    bands: Array
    """Share of the squared error in each band."""


def error_parts(
    model: Model, blocks: Sequence[Segment], y_hat: Sequence[Array], scale: Array, step: float
) -> ErrorParts:
    """Split the error of simulated blocks (H, ny); step: sampling time, s.

    Each part counts only what it explains beyond chance: a sum of squares is divided by the number
    of samples less the number of fitted values.
    """
    whole = [filled(b.y - y) / scale for b, y in zip(blocks, y_hat, strict=True)]
    length = min(_MOST_SAMPLES, *(len(e) for e in whole))
    of = windows(blocks, y_hat, length, first=True)
    started = _best_starts(model, of, scale) if isinstance(model, StepModel) else None
    if started is None:
        before = after = np.stack([e[:length] for e in whole])
        fitted = np.zeros(len(after))
    else:
        before, after = (
            (of.y - r.y.transpose(1, 0, 2)) / scale for r in (started.free, started.best)
        )
        fitted = np.array([_rank(slopes) for slopes in started.slopes], np.float64)
    samples, outputs = length * len(scale), len(scale)
    total = float(np.sum(before**2)) + 1e-300
    # Mean squares in each window; what chance alone explains does not count.
    first = np.sum(after**2, axis=(1, 2)) * samples / np.maximum(samples - fitted, 1)
    first = np.minimum(first, np.sum(before**2, axis=(1, 2)))
    times = np.outer((np.arange(length) + 0.5) / length, np.arange(4 if length >= 200 else 1))
    basis = np.linalg.qr(np.cos(np.pi * times))[0]
    rest = np.sum((after - basis @ (basis.T @ after)) ** 2, axis=(1, 2))
    free = samples - fitted - basis.shape[1] * outputs
    rest = np.minimum(rest * samples / np.maximum(free, 1), first)
    parts = [np.array_split(e**2, min(10, length)) for e in whole]
    course = [np.mean(np.concatenate(each)) for each in zip(*parts, strict=True)]
    return ErrorParts(
        None if started is None else 1.0 - float(first.sum()) / total,
        float(first.sum() - rest.sum()) / total,
        float(rest.sum()) / total,
        np.sqrt(course),
        *_spectrum(whole, step),
    )


_STEPS = (1, 5, 20)


def steps_ahead(
    model: Model, blocks: Sequence[Segment], y_hat: Sequence[Array], scale: Array
) -> dict[int, float]:
    """Return the RMS error at some steps after starts from measured past windows, in standard
    deviations of the outputs.

    An error at the first step is in the dynamics or in the initial state; one that only grows later
    has accumulated. {} for a model without steps, and for blocks that are too short.
    """
    shortest = min(len(b.y) for b in blocks)
    steps = [k for k in _STEPS if k <= shortest]
    if not isinstance(model, StepModel) or not steps:
        return {}
    of = windows(blocks, y_hat, steps[-1])
    e = (of.y.transpose(1, 0, 2) - rollout(model, of).y) / scale
    return {k: float(np.sqrt(np.mean(e[k - 1] ** 2))) for k in steps}


@dataclass(frozen=True)
class FinerStep:
    """V of held-out blocks with the step of the integration and with half of it."""

    value: float
    half: float
    error: float
    """Standard error of V over parts of the blocks."""

    @property
    def matters(self) -> bool:
        """Whether V changes by more than its standard error."""
        return abs(self.half - self.value) > self.error


_PARTS = 24


def halved_step(
    model: Model, blocks: Sequence[Segment], y_hat: Sequence[Array], scale: Array
) -> FinerStep | None:
    """Simulate held-out blocks with half the step of the integration; None for a model without a
    method `halved()`, which returns the model with it, and one that diverges then."""
    halved = getattr(model, "halved", None)
    if not callable(halved):
        return None
    finer: Any = halved()
    squares: list[list[Array]] = [[], []]
    for block, coarse in zip(blocks, y_hat, strict=True):
        fine = np.asarray(finer.simulate(block.past_u[None], block.past_y[None], block.u[None])[0])
        for each, y in zip(squares, (coarse, fine), strict=True):
            each.append((filled(block.y - y) / scale) ** 2)
    means = [np.concatenate(each) for each in squares]
    if not np.isfinite(means[1]).all():
        return None
    value, half = (float(np.sqrt(m.mean(axis=0)).mean()) for m in means)
    parts = [np.sqrt(np.mean(m)) for m in np.array_split(means[0], min(_PARTS, len(means[0])))]
    return FinerStep(value, half, float(np.std(parts) / np.sqrt(len(parts))))


def _spectrum(errors: Sequence[Array], sampling_time: float) -> tuple[Array, Array]:
    """Five bands from 0 to the Nyquist frequency, of equal width on a logarithmic axis, and the
    share of the squared error in each."""
    longest = max(len(e) for e in errors)
    frequencies = np.fft.rfftfreq(longest, sampling_time)
    power = np.zeros(len(frequencies))
    for e in errors:
        found = np.abs(np.fft.rfft(e, n=longest, axis=0)) ** 2
        power += found.sum(axis=1)
    low, high = frequencies[min(1, len(frequencies) - 1)], frequencies[-1]
    edges = np.concatenate([[0.0], np.geomspace(max(2 * low, 1e-300), max(high, 2 * low), 6)[1:]])
    bands = np.searchsorted(edges[1:-1], frequencies, side="right")
    shares = np.bincount(bands, weights=power, minlength=5) / max(float(power.sum()), 1e-300)
    return edges, shares


# Missing terms, ranked by a score test.


Place = Literal["at the input", "in the dynamics", "at the output"]


@dataclass(frozen=True)
class MissingTerm:
    """A term and what it would explain of the residual of one output."""

    output: int
    term: str
    """Such as `position^3` or `sign(rate(position))`."""
    where: Place
    """A force with a function of inputs alone is `at the input`."""
    share: float
    """Share of the squared residual that it explains beyond linear terms, mean over the folds. A
    linear term counts beyond a constant, an earlier input beyond the input itself."""
    folds: int
    """Number of folds in which it explains more than chance, of all terms together."""
    linear: bool
    """Whether it is a signal, now or earlier: the order, the delay or the fit is at fault."""


_CHANCE = 1e-3
_DIRECTIONS = 3
_MOST_SIGNALS = 8
_LOCAL = 0.3
"""Largest error of windows, in standard deviations of the output, at which the slope of the
simulation describes a change of the model."""


def _terms(
    signals: dict[str, Array], inputs: dict[str, Array], partners: Sequence[str] = ()
) -> dict[str, Array]:
    """Candidate terms (B, H) of signals (B, H): odd and even functions, limits, products, the
    delays of inputs (B, 16 + H), and products of these with the signals named as partners."""
    found: dict[str, Array] = {}
    centred: dict[str, Array] = {}
    centred_at: dict[str, float] = {}
    for name, s in signals.items():
        low, high = np.quantile(s, (0.02, 0.98))
        crosses = low < -0.05 * high and high > -0.05 * low
        centred_at[name] = 0.0 if crosses else float(s.mean())
        z = centred[name] = s - centred_at[name]
        label = name if crosses else f"({name} - mean)"
        found |= {f"{label}^2": z**2, f"{label}^3": z**3}
        if crosses:
            found |= {
                f"|{name}|": np.abs(z),
                f"{name} * |{name}|": z * np.abs(z),
                f"sign({name})": np.tanh(z / (0.05 * float(np.std(s)))),
            }
        elif low > 0:
            found[f"sqrt({name})"] = np.sqrt(np.maximum(s, 0.0))
        edges = np.quantile(s, (0.15, 0.85))
        found[f"{name} below its 15 % quantile"] = np.minimum(s - edges[0], 0.0)
        found[f"{name} above its 85 % quantile"] = np.maximum(s - edges[1], 0.0)
    names = list(signals)
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            found[f"{one} * {other}"] = centred[one] * centred[other]
    for name, u in inputs.items():
        for delay in _DELAYS:
            late = u[:, _DELAYS[-1] - delay : -delay]
            found[f"{name}, {delay} sample{'s' * (delay > 1)} before"] = late
            for other in partners:
                product = (late - centred_at[name]) * centred[other]
                found[f"{name}(k-{delay}) * {other}"] = product
    return found


def missing_terms(
    models: Sequence[Model],
    blocks: Sequence[Sequence[Segment]],
    y_hat: Sequence[Sequence[Array]],
    inputs: Sequence[str],
    outputs: Sequence[str],
    states: Sequence[str] = (),
) -> tuple[MissingTerm, ...]:
    """Rank terms by the share of the residual that each would explain if the model had it.

    A small force with the form of the term acts on the state. The change of the outputs is the
    slope of the simulation with the gain of the term, and its product with the residual the slope
    of the squared error: a score test. It holds near the fit only. So the records are cut into
    windows, as long as possible, in which the model with the best initial state is near, and the
    initial states are fitted with the gain. Forces along a few independent directions of the state
    are fitted together, beyond a constant force and forces linear in the signals. A model without
    `step` gets a moving average of the term instead.

    Args:
        models: one a fold
        blocks, y_hat: blocks of each fold and their simulations (H, ny)
        states: names of the states that have one; others are called x1, x2, ...

    Returns:
        the terms that explain more than chance in at least half of the folds, the nonlinear ones
        of each output first, the largest share first
    """
    found: dict[tuple[int, str, Place, bool], list[tuple[float, bool]]] = {}
    for model, own, simulated in zip(models, blocks, y_hat, strict=True):
        responses = _responses(model, own, simulated, inputs, outputs, states)
        for k in range(len(outputs)):
            e = list(responses.residual[:, :, k])
            linear = {n: c[:, :, k] for n, c in responses.linear.items()}
            every, constant = np.concatenate([*linear.values()], axis=2), linear.pop("constant")

            def force(name: str, own: _Responses = responses) -> Place:
                return "at the input" if name in own.of_inputs else "in the dynamics"

            jobs: list[tuple[str, Place, Array, Array]] = [
                (n, force(n), c, constant) for n, c in linear.items()
            ]
            for n, c in responses.dynamic.items():
                late, _, delay = n.partition(", ")
                base = np.concatenate([constant, linear[late]], axis=2) if delay else every
                jobs.append((n, force(n), c[:, :, k], base))
            for n, c in responses.static.items():
                jobs.append((n, "at the output", c[:, :, k, None], every))
            for name, where, columns, base in jobs:
                one = explained(e, list(base), list(columns))
                sure = one.chance * len(jobs) < _CHANCE and one.share > 0
                is_linear = name in linear or ", " in name
                found.setdefault((k, name, where, is_linear), []).append((one.share, sure))
    ranked: list[MissingTerm] = []
    for (output, term, where, linear), each in found.items():
        sure = sum(sure for _, sure in each)
        if 2 * sure >= len(models):
            share = float(np.mean([share for share, _ in each]))
            ranked.append(MissingTerm(output, term, where, share, sure, linear))
    return tuple(sorted(ranked, key=lambda t: (t.output, t.linear, -t.share)))


def terms_beyond_linear(
    records: Sequence[Trajectory], context: Context, rule: ProtocolRule
) -> tuple[MissingTerm, ...]:
    """Rank the terms that a linear model of the training records lacks, the largest share first.

    Only nonlinear terms count, and only where whole records are simulated.
    """
    if rule.horizon is not None:
        return ()
    from asia.models import linear  # not needed by the tools of a workspace

    model = linear.build(linear.Config(max_order=4, delay=None), context)
    model = linear.train(model, records, context, LevenbergMarquardt(iterations=15))
    blocks = whole(tuple(records), rule)
    y_hat = [model.simulate(b.past_u[None], b.past_y[None], b.u[None])[0] for b in blocks]
    names = ([s.name for s in signals] for signals in (context.inputs, context.outputs))
    found = missing_terms([model], [blocks], [y_hat], *names)
    return tuple(sorted((t for t in found if not t.linear), key=lambda t: -t.share))


@dataclass(frozen=True)
class _Responses:
    """Residual of windows, and the slopes of their simulation with the gains of terms."""

    residual: Array
    """(B, H, ny)."""
    linear: dict[str, Array]
    """`constant`, signal -> (B, H, ny, directions)."""
    dynamic: dict[str, Array]
    """Term in the dynamics -> (B, H, ny, directions)."""
    static: dict[str, Array]
    """Term at the output -> (B, H, ny)."""
    of_inputs: frozenset[str]
    """Signals and terms in the dynamics that are functions of inputs alone."""


def _responses(
    model: Model,
    blocks: Sequence[Segment],
    y_hat: Sequence[Array],
    inputs: Sequence[str],
    outputs: Sequence[str],
    states: Sequence[str],
) -> _Responses:
    scale = spread_of(np.concatenate([b.y for b in blocks]))
    scale = np.where(scale > 0, scale, 1.0)
    length = min(_MOST_SAMPLES, *(len(b.y) for b in blocks))
    of, started = windows(blocks, y_hat, length, first=True), None
    early = _earlier_inputs(blocks, length, first=True)
    if isinstance(model, StepModel):
        while True:
            of = windows(blocks, y_hat, length)
            started = _best_starts(model, of, scale)
            if started is None:
                of = windows(blocks, y_hat, length, first=True)
                break
            e = (of.y - started.best.y.transpose(1, 0, 2)) / scale
            early = _earlier_inputs(blocks, length, first=False)
            far = float(np.sqrt(np.mean(e**2)))
            if far <= _LOCAL or length < 50:
                break
            length //= 2
    y = of.y_hat if started is None else started.best.y.transpose(1, 0, 2)
    signals = {name: y[:, :, k] for k, name in enumerate(outputs)}
    signals |= {f"rate({name})": np.gradient(y[:, :, k], axis=1) for k, name in enumerate(outputs)}
    signals |= {name: of.u[:, :, k] for k, name in enumerate(inputs)}
    driven = list(inputs)
    if started is not None and len(started.size) <= 8:
        for k in range(len(started.size)):
            s = started.best.states[:-1, :, k].T
            name = states[k] if k < len(states) else f"x{k + 1}"
            # A state that holds back an input is known by that input.
            for d, (i, u) in itertools.product(range(1, _DELAYS[-1] + 1), enumerate(inputs)):
                if _same(s[:, d:], of.u[:, :-d, i], 1.0 - 1e-6):
                    name = f"{u}(k-{d})"
                    driven.append(name)
            signals.setdefault(name, s)
    kept: dict[str, Array] = {}
    for name, s in signals.items():
        moves = np.ptp(s) > 1e-9 * (np.abs(s).max() + 1e-300)
        if len(kept) < _MOST_SIGNALS and moves and not any(_same(s, t) for t in kept.values()):
            kept[name] = s
    early = np.concatenate([early, of.u], axis=1)
    own = {n: kept[n] for n in driven if n in kept}
    late = {n: early[:, :, k] for k, n in enumerate(inputs) if n in kept}
    partners = [n for n in (*inputs, *outputs) if n in kept]
    terms, of_inputs = _terms(kept, late, partners), frozenset([*own, *_terms(own, late)])
    measured = {n: s for n, s in kept.items() if n in outputs}
    # A drift acts at the output; so does a sensor.
    time = np.broadcast_to(np.arange(y.shape[1], dtype=np.float64), y.shape[:2])
    static = _terms(measured, {}) | ({"time": time} if y.shape[1] > 200 else {})
    same_size = np.ones(len(outputs))
    at_output = {n: v[:, :, None] * same_size for n, v in static.items()}
    linear = {"constant": np.ones(y.shape[:2]), **kept}
    if started is None or not isinstance(model, StepModel):
        every = {
            n: _lagged(v)[:, :, None].repeat(len(outputs), 2) for n, v in (linear | terms).items()
        }
        base = {n: every[n] for n in linear}
        return _Responses(of.y - y, base, {n: every[n] for n in terms}, at_output, of_inputs)
    every = _forced(model, of, started, linear | terms)
    starts = np.stack([np.pad(b, ((0, 0), (0, len(started.size) - b.shape[1])))
                       for b in (_kept(slopes)[0] for slopes in started.slopes)])  # fmt: skip

    def beyond(x: Array) -> Array:
        """Slopes (B, H, ny, ...) that no change of the initial state has."""
        shape = (*x.shape[:2], len(outputs), -1)
        scaled = (x.reshape(shape) / scale[:, None]).reshape(len(x), -1, x[0, 0, 0].size)
        left = scaled - starts @ (starts.transpose(0, 2, 1) @ scaled)
        return (left.reshape(*x.shape[:2], len(outputs), -1) * scale[:, None]).reshape(x.shape)

    return _Responses(
        beyond(of.y - y),
        {n: beyond(every[n]) for n in linear if n in every},
        {n: beyond(every[n]) for n in terms if n in every},
        {n: beyond(v) for n, v in at_output.items()},
        of_inputs,
    )


def _same(one: Array, other: Array, least: float = 0.98) -> bool:
    """Whether two signals (B, H) are correlated at least as much."""
    a, b = (z - z.mean() for z in (one, other))
    return abs(float(np.sum(a * b))) > least * float(np.sqrt(np.sum(a**2) * np.sum(b**2)))


def _lagged(z: Array) -> Array:
    """A term and its past (B, H, lags): what a model without states may do with it."""
    lags = [0, *(d for d in _DELAYS if d < z.shape[1] // 6)]
    late = [np.concatenate([np.repeat(z[:, :1], d, 1), z[:, : z.shape[1] - d]], 1) for d in lags]
    return np.stack(late, axis=2)


def _forced(
    model: StepModel, of: SimulatedSegment, started: _Started, terms: dict[str, Array]
) -> dict[str, Array]:
    """Slopes (B, H, ny, directions) of the outputs with the gain of each term as a force; terms
    with a response that is not finite are left out."""
    from scipy.linalg import qr

    best, size, batch = started.best, started.size, len(of.u)
    # The directions of the state with the most different effects on the outputs.
    flat = started.slopes.reshape(-1, len(size))
    found: Any = qr(np.linalg.qr(flat, mode="r"), mode="economic", pivoting=True)
    order, diagonal = found[2], np.abs(np.diagonal(found[1]))
    many = min(_DIRECTIONS, int(np.sum(diagonal > 1e-3 * max(float(diagonal[0]), 1e-300))))
    directions = np.repeat(np.diag(size)[order[:many]], batch, axis=0)
    # Each term with the RMS value 1, as a force of a small part of the size of the state.
    forces = [_SMALL * z.T / max(float(np.sqrt(np.mean(z**2))), 1e-300) for z in terms.values()]
    times = many * len(terms)
    y = rollout(
        model,
        _repeated(of, times),
        np.tile(best.states[0], (times, 1)),
        np.concatenate([np.tile(force, (1, many)) for force in forces], axis=1),
        np.tile(directions, (len(terms), 1)),
    ).y
    slopes = (y.reshape(len(y), len(terms), many, batch, -1) - best.y[:, None, None]) / _SMALL
    every = zip(terms, slopes.transpose(1, 3, 0, 4, 2), strict=True)
    return {name: part for name, part in every if np.isfinite(part).all()}


# Modes of the model around the mean of its simulated states.


def modes(model: StepModel, block: Segment, y_hat: Array, step: float) -> Iterator[str]:
    """Describe the modes of the derivative of a step, the slowest first: frequency and damping of
    an oscillation, else the time constant. step: sampling time, s."""
    of = windows([block], [y_hat], min(len(y_hat), _MOST_SAMPLES), first=True)
    states = rollout(model, of).states
    mean, size = states.mean(axis=(0, 1)), _sizes(states)
    moving = np.flatnonzero(size > 0)
    if not 0 < len(moving) <= _MOST_STATES or not np.isfinite(states).all():
        return
    held = _repeated(replace(of, u=of.u.mean(axis=1, keepdims=True)), len(moving) + 1)
    start = mean + np.concatenate([np.zeros((1, len(mean))), _SMALL * np.diag(size)[moving]])
    after = rollout(model, held, start).states[-1][:, moving]
    a = (after[1:] - after[0]).T / (_SMALL * size[moving])
    if not np.isfinite(a).all():
        return
    none = np.zeros((len(a), 0))
    found = LinearModel(a, none, none.T, np.zeros((0, 0)), step, none[0], none[0])
    for pole, frequency, damping, constant in found.modes():
        # A pole near zero is a delay, not a mode.
        if abs(pole) < 1e-2 or np.isnan(frequency):
            continue
        if found.integrates(pole):
            yield "integrator"
        elif pole.imag > 0:
            yield f"{frequency:.4g} Hz, damping {damping:.3g}"
        elif constant > 0:
            yield f"time constant {constant:.4g} s"
        else:
            yield f"unstable, doubles in {-0.693 * constant:.3g} s"
