"""Delayed signals of equations: whole records at once, and sample by sample from a buffer.

A sample is a parcel: the volume that enters while it is held. What leaves during a step is the mean
over the volume that the step displaces, so that a constant delay interpolates linearly between
samples, and what enters is what leaves. Before the first sample its value is held.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.config import GreyBoxStructure
from asia.problem.memory import NOTHING, TransportDelay

# Least width of the volume that leaves, relative to the volume it flows through: with no flow a
# value stays in place.
_LEAST, _TINY = 1e-6, 1e-300
# Length of a buffer, in longest delays of the records, where the delay varies.
_SPARE = 2
# Volumes over which a mean with dispersion is taken, in standard deviations, and their weights, on
# the rectangle with that deviation. Greatest squared deviation, relative to the volume.
_VOLUMES = tuple((3**0.5 * x, 0.5 * w) for x, w in zip(*leggauss(5), strict=True))
_MOST_SPREAD = 1 / 3


def constant_flow(value: AnyArray, delay: AnyArray, length: int) -> AnyArray:
    """Delay values (T, ...) by `delay` (T or 1, ...) samples, up to those of a buffer of `length`
    samples; linear between samples."""
    xp = namespace(value, delay)
    last = len(value) - 1
    now = np.arange(len(value)).reshape(-1, *(1,) * (value.ndim - 1))
    delay = xp.minimum(xp.maximum(delay, 0.0), length - 1.0)
    position = xp.maximum(now - xp.where(delay >= 0, delay, 0.0), 0.0)
    shape = np.broadcast_shapes(value.shape, position.shape)
    value, position = xp.broadcast_to(value, shape), xp.broadcast_to(position, shape)
    older = xp.floor(position)
    index = older.astype(int)
    later = position - older
    before = xp.take_along_axis(value, index, axis=0)
    after = xp.take_along_axis(value, xp.minimum(index + 1, last), axis=0)
    return (1.0 - later) * before + later * after


def varying_flow(
    one: TransportDelay, value: Array, entering: Array, volume: Array, dispersion: Array,
    length: int,
) -> tuple[Array, int]:  # fmt: skip
    """Signal (T, ...) behind a volume (T, ...), from the value and the volume that enter in each
    sample, and the dispersion (T, ...); `length` is the number of samples in the buffer.

    Returns:
        The delayed signal, and the number of samples that an unlimited buffer would hold.
    """
    samples, shape = len(value), value.shape[1:]
    value, entering, volume, dispersion = (
        a.reshape(samples, -1) for a in (value, entering, volume, dispersion)
    )
    zeros = np.zeros((1, value.shape[1]))
    first = value[:1]
    deviation = value - first
    edges = np.concatenate([zeros, np.cumsum(entering, axis=0)])
    content = np.concatenate([zeros, np.cumsum(deviation * entering, axis=0)])
    near, ends = _bounds(one, volume, entering, dispersion)
    now, columns = np.arange(samples)[:, None], np.arange(value.shape[1])
    # Each column is searched in an interval of its own.
    size = np.maximum(edges[-1], _TINY)
    known = (edges / size + 2.0 * columns).T.ravel()

    def parcel(place: Array) -> NDArray[np.intp]:
        """Parcel at a place, -1 before the first one."""
        sought = np.nan_to_num(np.clip(place / size, -0.5, 1.0)) + 2.0 * columns
        index = np.searchsorted(known, sought.T.ravel(), side="right").reshape(-1, samples).T
        return np.minimum(index - 1 - (samples + 1) * columns, now)

    def amount(depth: Array) -> tuple[Array, NDArray[np.intp]]:
        """Integral of the deviation over the volume from the first parcel to a depth, and the
        parcel there."""
        place = edges[1:] - depth
        index = parcel(place)
        kept = np.maximum(index, np.maximum(now + 1 - length, 0))
        beyond = place - edges[kept, columns]
        return content[kept, columns] + deviation[kept, columns] * beyond, index

    delayed = first.repeat(samples, axis=0)
    above, last = amount(near)
    for far, weight in ends:
        below, last = amount(far)
        delayed += weight * (above - below)
    return delayed.reshape(samples, *shape), int((now - last).max(initial=0)) + 2


def _bounds(
    one: TransportDelay, volume: AnyArray, entering: AnyArray, dispersion: AnyArray
) -> tuple[AnyArray, list[tuple[AnyArray, AnyArray]]]:
    """Bounds of the volume whose mean is the signal, as depths from the inlet at the end of a step:
    the nearer one, and further ones with the inverse of a width. That is what leaves in the step,
    spread by dispersion, or all that is inside."""
    xp = namespace(volume, entering)
    volume = xp.maximum(volume, 0.0)
    square = xp.minimum(2.0 * xp.maximum(dispersion, 0.0), _MOST_SPREAD)
    if one.mean:
        near = (0.5 if one.ahead else 1.0) * entering
        width = xp.maximum(volume, _LEAST * entering) + _TINY
        nodes = _VOLUMES if one.dispersion != NOTHING else ((0.0, 1.0),)
        spread = xp.sqrt(square)
        return near, [(near + width * (1.0 + k * spread), w / width) for k, w in nodes]
    width = xp.maximum(entering, _LEAST * volume) + _TINY
    near = volume - 0.5 * width * one.ahead
    if one.dispersion != NOTHING:
        # A rectangle with the variance of both.
        wide = xp.sqrt(width**2 + 12.0 * square * volume**2)
        near, width = near - 0.5 * (wide - width), wide
    near = xp.maximum(near, 0.0)
    return near, [(near + width, 1.0 / width)]


def stirred(
    before: AnyArray, value: AnyArray, entering: AnyArray, volume: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Mean of what leaves a mixed volume in a step, and what it holds at its end, from what it held
    before, each (...)."""
    xp = namespace(before, value, volume)
    volume = xp.maximum(volume, _LEAST * entering) + _TINY
    fresh = 1.0 - xp.exp(-entering / volume)
    share = xp.where(entering > 0, fresh * volume / xp.maximum(entering, _TINY), 1.0)
    return value + (before - value) * share, before + (value - before) * fresh


def buffered(
    one: TransportDelay, past: AnyArray, value: AnyArray, depth: AnyArray, volume: AnyArray,
    entering: AnyArray, dispersion: AnyArray,
) -> AnyArray:  # fmt: skip
    """Signal (...) behind a volume (...), from past values (L - 1, ...), oldest first, this one
    (...), and the volume (L, ...) that entered after each of them."""
    xp = namespace(past, value, depth)
    near, ends = _bounds(one, volume, entering, dispersion)
    shape = np.broadcast_shapes(past.shape[1:], value.shape, depth.shape[1:], near.shape)
    shape = np.broadcast_shapes(shape, ends[0][0].shape)
    known = xp.concatenate(
        [xp.broadcast_to(past, (len(past), *shape)), xp.broadcast_to(value, (1, *shape))]
    )
    found = xp.zeros(shape, known.dtype)
    for far, weight in ends:
        share = xp.minimum(xp.maximum((depth - near) / (far - near), 0.0), 1.0)
        share = xp.broadcast_to(share, (len(depth), *shape))
        # The oldest value is held before it.
        before = xp.concatenate([xp.ones((1, *shape), share.dtype), share[:-1]])
        found = found + weight * (far - near) * (known * (before - share)).sum(axis=0)
    return found


# Delays of the equations in a simulation.


def _is_uniform(structure: GreyBoxStructure, one: TransportDelay) -> bool:
    return one.uniform and structure.time_step is None


def _entering(structure: GreyBoxStructure, flow: AnyArray, u: AnyArray) -> AnyArray:
    """Volume that enters in a sample, from the flow (...) and inputs u (nu, ...)."""
    xp, time = namespace(flow, u), structure.sampling_time
    if structure.time_step is not None:
        time = xp.maximum(u[structure.time_step], 0.0)
    return xp.maximum(flow, 0.0) * time


def along_record(
    structure: GreyBoxStructure, parameters: Array, u: Array, x: Array | None = None
) -> tuple[Array, tuple[int, ...]]:
    """Append the signals of delays to inputs u (T, nu, R, S), with parameters (np, R): those that
    read no state, and with states x (nx, T, R, S) all.

    Returns:
        u (T, nu + n, R, S), and the number of samples that the buffer of each delay should hold.
    """
    system, needed = structure.equations, list[int]()
    every = system.delays if x is not None else system.delays[: system.driven]
    if not every:
        return u, ()
    shape = (len(u), max(u.shape[2], parameters.shape[1]), u.shape[3])
    rows = list(np.broadcast_to(u.swapaxes(0, 1), (u.shape[1], *shape)))
    states = np.zeros((0, *shape)) if x is None else x
    for k, one in enumerate(every):
        known = np.array(rows)
        value, flow, volume, spread = system.passage(k, parameters[..., None], states, known)
        entering = _entering(structure, flow, known)
        length = structure.memory[k] if structure.memory else len(u)
        if _is_uniform(structure, one):
            delay = volume / entering - 0.5 * one.ahead
            rows.append(constant_flow(value, delay, length))
            delay = np.nan_to_num(delay, nan=0.0)
            varies = (delay[0] != delay).any()
            longest = int(np.ceil(np.clip(delay.max(initial=0.0), 0.0, len(u)))) + 2
        elif one.mixed:
            held, means = value[0], list[Array]()
            for parts in zip(value, entering, volume, strict=True):
                mean, held = stirred(held, *parts)
                means.append(mean)
            rows.append(np.array(means))
            varies, longest = False, 2
        else:
            found, longest = varying_flow(one, value, entering, volume, spread, length)
            rows.append(found)
            varies = True
        needed.append(min(_SPARE * longest if varies else longest, len(u) + 2))
    return np.array(rows).swapaxes(0, 1), tuple(needed)


def empty_buffer(
    structure: GreyBoxStructure, parameters: AnyArray, x: AnyArray, u: AnyArray
) -> AnyArray:
    """Buffer (L - 1, columns, R, S) before a first sample whose values have always been held, of
    the delays that the rows of u (nu + n, R, S) do not hold yet."""
    system, xp = structure.equations, namespace(parameters, x, u)
    first = len(u) - structure.nu
    every = system.delays[first:]
    shape = x.shape[1:]
    u = xp.broadcast_to(u, (len(u), *shape))
    length = max((structure.memory[k] for k in range(first, len(system.delays))), default=1)
    made: list[AnyArray] = []
    for k, one in enumerate(every, first):
        value, *_ = system.passage(k, parameters[..., None], x, u)
        made.append(value)
        if not (one.mixed or _is_uniform(structure, one)):
            made.append(xp.zeros_like(value))
        u = xp.concatenate([u, value[None]])
    if not made:
        return xp.zeros((0, 0, *shape))
    return xp.repeat(xp.stack(made)[None], length - 1, axis=0)


def advance_buffer(
    structure: GreyBoxStructure, parameters: AnyArray, line: AnyArray, x: AnyArray, u: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Put a sample into a buffer: states x (nx, R, S), inputs u (nu + n, R, S) -> the buffer after
    it, and the inputs with the signals of all delays (nu + m, R, S)."""
    system, xp = structure.equations, namespace(parameters, line, x, u)
    shape, first = x.shape[1:], len(u) - structure.nu
    u = xp.broadcast_to(u, (len(u), *shape))
    kept: list[AnyArray] = []
    place = 0
    for k in range(first, len(system.delays)):
        one, length = system.delays[k], structure.memory[k]
        value, flow, volume, spread = system.passage(k, parameters[..., None], x, u)
        entering = _entering(structure, flow, u)
        if one.mixed:
            found, held = stirred(line[-1, place], value, entering, volume)
            kept.append(xp.concatenate([line[:, place], held[None]]))
            u = xp.concatenate([u, found[None]])
            place += 1
            continue
        past = line[len(line) - length + 1 :, place]
        kept.append(xp.concatenate([line[:, place], value[None]]))
        if _is_uniform(structure, one):
            depth = np.arange(length - 1.0, -1.0, -1.0)[:, None, None] * entering
            place += 1
        else:
            grown = xp.concatenate([line[:, place + 1] + entering, xp.zeros((1, *shape))])
            kept.append(grown)
            depth = grown[len(grown) - length :]
            place += 2
        found = buffered(one, past, value, depth, volume, entering, spread)
        u = xp.concatenate([u, found[None]])
    after = xp.stack(kept, axis=1)[1:] if kept else line
    return after, u
