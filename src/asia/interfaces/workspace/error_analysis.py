"""Analysis of the error of a fitted candidate: what it consists of, and which term would explain it.

A model with `initial` and `step` is simulated with changed states, all changes as one batch. So the
response of the outputs to a force on a state is exact at the current fit, whatever the model is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import Model, StepModel
from asia.data.trajectory import Array, filled, spread_of
from asia.errors import InternalError
from asia.judge.evaluation.requests import spread
from asia.judge.scoring.checks.residual import explained
from asia.lowering.linear import LinearModel
from asia.problem.folds import Block, Case

# Samples of a fold that are analysed, as whole blocks or the start of long ones, and states.
_MOST_SAMPLES, _MOST_STATES = 3000, 150
_SMALL = 1e-4
"""Size of a change for a derivative, in standard deviations of the state."""


def shortened(blocks: Sequence[Block]) -> tuple[Block, ...]:
    """Blocks evenly spread, each from its start, with at most `_MOST_SAMPLES` samples together."""
    longest = max(len(block.y) for block in blocks)
    chosen = spread(blocks, max(1, min(len(blocks), _MOST_SAMPLES // longest)))
    each = _MOST_SAMPLES // len(chosen)
    return tuple(
        replace(b, y=b.y[:each], case=replace(b.case, u=b.case.u[:each])) for b in chosen
    )


@dataclass(frozen=True)
class Rollout:
    """Simulations of one case from several states."""

    states: Array
    """State at each sample, (H, B, n): all numbers of the tree of states that are floating."""
    y: Array
    """Outputs (H, B, ny)."""
    last: Array
    """State after the last sample, (B, n)."""


def rollout(
    model: StepModel,
    case: Case,
    start: Array | None = None,
    force: Array | None = None,
    direction: Array | None = None,
) -> Rollout:
    """Simulate a case as a batch.

    Args:
        start: initial states (B, n) in place of those of the model
        force: (H, B), added to each next state along `direction`
        direction: (B, n)
    """
    import jax  # only to take trees of states apart

    batch = 1 if start is None else len(start)
    batch = batch if force is None else force.shape[1]
    past_u, past_y, u = (np.repeat(x[None], batch, 0) for x in (case.past_u, case.past_y, case.u))
    leaves, tree = jax.tree.flatten(model.initial(past_u, past_y, u[:, 0]))

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
    states, outputs = list[Array](), list[Array]()
    for k in range(len(case.u)):
        states.append(vector(leaves))
        state, y = model.step(jax.tree.unflatten(tree, leaves), u[:, k])
        leaves = jax.tree.leaves(state)
        if force is not None and direction is not None:
            leaves = with_vector(leaves, vector(leaves) + force[k][:, None] * direction)
        outputs.append(np.asarray(y, np.float64))
    return Rollout(np.stack(states), np.stack(outputs), vector(leaves))


def _floating(leaf: Any) -> bool:
    return np.issubdtype(np.asarray(leaf).dtype, np.floating)


def _sizes(states: Array) -> Array:
    """Typical change (n,) of each state in (H, n); 0 for one that stays at zero."""
    moved = states.std(axis=0)
    return np.where(moved > 1e-12, moved, 1e-2 * np.abs(states).max(axis=0, initial=0.0))


def _initial_slopes(model: StepModel, case: Case, x0: Array, size: Array, y: Array) -> Array:
    """Change of the outputs (H, ny, n) for a change of each initial state by its size."""
    start = x0 + _SMALL * np.diag(size)
    slopes = (rollout(model, case, start).y - y[:, None]) / _SMALL
    return np.nan_to_num(slopes.transpose(0, 2, 1))


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
    model: Model,
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    scale: Array,
    sampling_time: float,
) -> ErrorParts:
    """Split the error of simulated blocks.

    Each part counts only what it explains beyond chance: a sum of squares is divided by the number
    of samples less the number of fitted values.
    """
    chosen = shortened(blocks)
    whole = [filled(b.y - y) / scale for b, y in zip(blocks, y_hat, strict=True)]
    places = {(b.record, b.start): e for b, e in zip(blocks, whole, strict=True)}
    total = after_start = rest = 0.0
    known = isinstance(model, StepModel)
    for block in chosen:
        e = places[block.record, block.start][: len(block.y)]
        mean_square = float(np.mean(e**2))
        samples, left = e.size, e
        total += samples * mean_square
        if isinstance(model, StepModel):
            left, fitted = _best_start(model, block, scale, e)
            if fitted is None:
                known = False
            else:
                free = float(np.sum(left**2)) / max(samples - fitted, 1)
                mean_square = min(mean_square, free)
                left = e if mean_square < free else left
        after_start += samples * mean_square
        columns = np.cos(
            np.pi * np.outer((np.arange(len(e)) + 0.5) / len(e), range(4 if len(e) >= 200 else 1))
        )
        basis = np.linalg.qr(columns)[0]
        slow = left - basis @ (basis.T @ left)
        free = float(np.sum(slow**2)) / max(samples - basis.shape[1] * e.shape[1], 1)
        rest += samples * min(mean_square, free)
    total = max(total, 1e-300)
    shortest = min(len(e) for e in whole)
    parts = [np.array_split(e**2, min(10, shortest)) for e in whole]
    course = [np.mean(np.concatenate(each)) for each in zip(*parts, strict=True)]
    return ErrorParts(
        1.0 - after_start / total if known else None,
        (after_start - rest) / total,
        rest / total,
        np.sqrt(course),
        *_spectrum(whole, sampling_time),
    )


def _best_start(
    model: StepModel, block: Block, scale: Array, e: Array
) -> tuple[Array, int | None]:
    """Errors (H, ny) from the initial state with the smallest squared error, and its number of
    determined values; None where the model has too many states or cannot be started elsewhere."""
    nominal = rollout(model, block.case)
    x0, size = nominal.states[0], _sizes(nominal.states[:, 0])
    y, n = nominal.y[:, 0], x0.shape[1]
    if not 0 < n <= _MOST_STATES or not size.any():
        return e, None
    least = target = float(np.sum(e**2))
    determined, best = 0, e
    steps = 0.5 ** np.arange(5)
    for _ in range(8):
        slopes = (_initial_slopes(model, block.case, x0, size, y) / scale[:, None]).reshape(-1, n)
        move, _, determined, _ = np.linalg.lstsq(slopes, best.ravel(), rcond=1e-4)
        tried = rollout(model, block.case, x0 + steps[:, None] * (move * size))
        errors = e[:, None] - (tried.y - nominal.y) / scale
        squares = np.nan_to_num(np.sum(errors**2, axis=(0, 2)), nan=np.inf)
        chosen = int(np.argmin(squares))
        if squares[chosen] >= least:
            break
        gained = least - squares[chosen]
        least, best = float(squares[chosen]), errors[:, chosen]
        x0, y = tried.states[0, chosen][None], tried.y[:, chosen]
        if gained < 1e-3 * target:
            break
    return best, int(determined)


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


@dataclass(frozen=True)
class MissingTerm:
    """A term and what it would explain of the residual of one output."""

    output: int
    term: str
    """Such as `position^3` or `sign(rate of position)`."""
    where: str
    """`in the dynamics` or `at the output`."""
    share: float
    """Share of the squared residual that it explains beyond linear terms, mean over the folds."""
    again: float
    """The share in parts of the records that its gain was not estimated on."""
    folds: int
    """Number of folds in which it explains more than chance, of all terms together."""


_CHANCE = 1e-3
_DELAYS = (1, 2, 4, 8, 16)
_DIRECTIONS = 4
_MOST_SIGNALS = 10


def _terms(signals: dict[str, Array], inputs: Sequence[str]) -> dict[str, Array]:
    """Candidate terms (H,) of signals (H,): odd and even functions, limits, products, delays and
    time."""
    found: dict[str, Array] = {}
    shifted: dict[str, Array] = {}
    for name, s in signals.items():
        low, high = np.quantile(s, (0.02, 0.98))
        crosses = low < -0.05 * high and high > -0.05 * low
        z = s if crosses else s - s.mean()
        size, label = float(np.std(s)) or 1.0, name if crosses or low > 0 else f"({name} - mean)"
        shifted[name] = z
        whole = z if crosses or low <= 0 else s
        found |= {f"{label}^2": whole**2, f"{label}^3": whole**3}
        if crosses:
            found |= {
                f"|{name}|": np.abs(z),
                f"{name} |{name}|": z * np.abs(z),
                f"sign({name})": np.tanh(z / (0.05 * size)),
            }
        elif low > 0:
            found |= {f"sqrt({name})": np.sqrt(np.maximum(s, 0.0))}
        for edge in np.quantile(s, (0.15, 0.85)):
            side, part = ("below", np.minimum) if edge < np.median(s) else ("above", np.maximum)
            found[f"{name} {side} {edge:.3g}"] = part(s - edge, 0.0)
    names = list(signals)
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            found[f"{one} * {other}"] = shifted[one] * shifted[other]
    for name in inputs:
        for delay in _DELAYS:
            if delay < len(signals[name]) // 6:
                late = np.concatenate(
                    [np.repeat(signals[name][:1], delay), signals[name][:-delay]]
                )
                found[f"{name} {delay} sample{'s' * (delay > 1)} later"] = late
    found["time"] = np.arange(len(next(iter(signals.values()))), dtype=np.float64)
    return found


def missing_terms(
    models: Sequence[Model],
    blocks: Sequence[Sequence[Block]],
    y_hat: Sequence[Sequence[Array]],
    inputs: Sequence[str],
    outputs: Sequence[str],
    states: Sequence[str] = (),
) -> tuple[MissingTerm, ...]:
    """Rank terms by the share of the residual that each would explain, had the model had it.

    A small force of the form of the term acts on the states; the change of the outputs is the
    slope of the simulation with the gain of the term, and its product with the residual is the
    slope of the squared error. Forces along a few independent directions of the state are fitted
    together, beyond a constant force and forces linear in the signals. A model without `step` is
    replaced by a moving average of the term.

    Args:
        models: one a fold
        blocks, y_hat: blocks of each fold and their simulations (H, ny)
        states: names of the states that have one; others are called x1, x2, ...

    Returns:
        the terms that explain more than chance in at least half of the folds, by `again`
    """
    found: dict[tuple[int, str, str], list[tuple[float, float, bool]]] = {}
    for model, whole, simulated in zip(models, blocks, y_hat, strict=True):
        places = {(b.record, b.start): y for b, y in zip(whole, simulated, strict=True)}
        chosen = shortened(whole)
        answers = [places[b.record, b.start][: len(b.y)] for b in chosen]
        parts = [
            _responses(model, b, y, inputs, outputs, states)
            for b, y in zip(chosen, answers, strict=True)
        ]
        shared = [name for name in parts[0].dynamic if all(name in p.dynamic for p in parts)]
        for k in range(len(outputs)):
            e = [filled(b.y - y)[:, k] for b, y in zip(chosen, answers, strict=True)]
            base = [np.concatenate([p.linear[:, k], p.static_linear], axis=1) for p in parts]
            direct = [name for name in parts[0].static if all(name in p.static for p in parts)]
            jobs = [("in the dynamics", n, [p.dynamic[n][:, k] for p in parts]) for n in shared]
            jobs += [("at the output", n, [p.static[n][:, None] for p in parts]) for n in direct]
            for where, name, columns in jobs:
                one = explained(e, base, columns)
                sure = one.chance * len(jobs) < _CHANCE and one.again > 0
                found.setdefault((k, name, where), []).append((one.share, one.again, sure))
    ranked: list[MissingTerm] = []
    for (output, term, where), each in found.items():
        share, again, sure = (np.array(x, np.float64) for x in zip(*each, strict=True))
        if 2 * sure.sum() >= len(models):
            values = float(share.mean()), float(again.mean())
            ranked.append(MissingTerm(output, term, where, *values, int(sure.sum())))
    return tuple(sorted(ranked, key=lambda t: (t.output, -t.again)))


@dataclass(frozen=True)
class _Responses:
    """Slopes of the simulation of one block with the gains of terms."""

    linear: Array
    """With those of a constant and the linear terms, (H, ny, columns)."""
    static_linear: Array
    """Outputs themselves (H, ny)."""
    dynamic: dict[str, Array]
    """Term -> (H, ny, directions)."""
    static: dict[str, Array]
    """Term of an output -> (H,), its own values."""


def _responses(
    model: Model,
    block: Block,
    y: Array,
    inputs: Sequence[str],
    outputs: Sequence[str],
    states: Sequence[str],
) -> _Responses:
    u, h = block.case.u, len(block.y)
    signals = {name: y[:, k] for k, name in enumerate(outputs)}
    measured = dict(signals)
    signals |= {f"rate of {name}": np.gradient(y[:, k]) for k, name in enumerate(outputs)}
    signals |= {name: u[:, k] for k, name in enumerate(inputs)}
    own: Rollout | None = rollout(model, block.case) if isinstance(model, StepModel) else None
    if own is not None and own.states.shape[2] > _MOST_STATES:
        own = None
    if own is not None and own.states.shape[2] <= 8:
        for k in range(own.states.shape[2]):
            name = states[k] if k < len(states) else f"x{k + 1}"
            signals.setdefault(name, own.states[:, 0, k])
    kept: dict[str, Array] = {}
    for name, s in signals.items():
        moves = np.ptp(s) > 1e-9 * (np.abs(s).max() + 1e-300)
        known = moves and any(abs(np.corrcoef(s, t)[0, 1]) > 0.98 for t in kept.values())
        if moves and not known and len(kept) < _MOST_SIGNALS:
            kept[name] = s
    terms = _terms(kept, [name for name in inputs if name in kept])
    linear = {"constant": np.ones(h), **kept}
    static = {
        name: value
        for name, value in _terms({n: s for n, s in measured.items() if n in kept}, ()).items()
    }
    if own is None or not isinstance(model, StepModel):
        every = {n: _lagged(v)[:, None].repeat(len(outputs), 1) for n, v in (linear | terms).items()}
    else:
        every = _forced(model, block.case, own, linear | terms)
    base = np.concatenate([every[name] for name in linear if name in every], axis=2)
    return _Responses(base, y, {n: every[n] for n in terms if n in every}, static)


def _lagged(z: Array) -> Array:
    """A term and its past (H, lags): what a model without states may do with it."""
    lags = [0, *(d for d in _DELAYS if d < len(z) // 6)]
    return np.stack([np.concatenate([np.repeat(z[:1], d), z[: len(z) - d]]) for d in lags], axis=1)


def _forced(
    model: StepModel, case: Case, nominal: Rollout, terms: dict[str, Array]
) -> dict[str, Array]:
    """Slopes (H, ny, directions) of the outputs with the gain of each term as a force; terms with
    a response that is not finite are left out."""
    from scipy.linalg import qr

    y, size = nominal.y[:, 0], _sizes(nominal.states[:, 0])
    slopes = _initial_slopes(model, case, nominal.states[0], size, y)
    _, r, order = qr(slopes.reshape(-1, len(size)), mode="economic", pivoting=True)
    diagonal = np.abs(np.diagonal(r))
    independent = int(np.sum(diagonal > 1e-3 * max(float(diagonal[:1].sum()), 1e-300)))
    chosen = order[: min(_DIRECTIONS, independent)]
    directions = np.diag(size)[chosen]
    names, many = list(terms), len(chosen)
    # Each term with the RMS value 1, as a force of a small part of the size of the state.
    force = np.stack([z / max(float(np.sqrt(np.mean(z**2))), 1e-300) for z in terms.values()], 1)
    force = np.repeat(force, many, axis=1) * _SMALL
    found = rollout(model, case, force=force, direction=np.tile(directions, (len(names), 1)))
    slopes = (found.y - y[:, None]) / _SMALL
    responses: dict[str, Array] = {}
    for place, name in enumerate(names):
        part = slopes[:, place * many : (place + 1) * many].transpose(0, 2, 1)
        if np.isfinite(part).all():
            responses[name] = part
    return responses


# Modes of the model around the mean of its simulated states.


def modes(model: StepModel, block: Block, sampling_time: float) -> Iterator[str]:
    """Describe the modes of the derivative of a step, the slowest first: frequency and damping of
    an oscillation, else the time constant."""
    case = replace(block.case, u=block.case.u[:_MOST_SAMPLES])
    states = rollout(model, case).states[:, 0]
    mean, size = states.mean(axis=0), _sizes(states)
    moving = np.flatnonzero(size > 0)
    if not 0 < len(moving) <= _MOST_STATES:
        return
    held = replace(case, u=case.u.mean(axis=0, keepdims=True))
    start = mean + np.concatenate([np.zeros((1, len(mean))), _SMALL * np.diag(size)[moving]])
    after = rollout(model, held, start).last[:, moving]
    a = (after[1:] - after[0]).T / (_SMALL * size[moving])
    if not np.isfinite(a).all():
        return
    none = np.zeros((len(a), 0))
    found = LinearModel(a, none, none.T, np.zeros((0, 0)), sampling_time, none[0], none[0])
    for pole, frequency, damping, constant in found.modes():
        if abs(pole) < 1e-2 or np.isnan(frequency):
            continue
        if abs(pole - 1.0) < 1e-6:
            yield "integrator"
        elif pole.imag > 1e-9:
            yield f"{frequency:.4g} Hz, damping {damping:.3g}"
        else:
            yield f"time constant {constant:.4g} s" if constant > 0 else (
                f"unstable, doubles in {-0.693 * constant:.3g} s"
            )
