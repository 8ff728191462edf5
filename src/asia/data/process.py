"""Transfer functions of lags and a delay, fitted to the records of one output.

y(t) = offset + sum_j K_j (1 + Z_j s) e^(-L_j s) / (s^i_j (1 + T_1j s) ...) u_j(t) + v(t), inputs
held or linear between samples, v autoregressive noise. Each input has its own lags, zero, delay and
integrator. Gains, zeros and offsets follow by least squares for given lags and delays, which are
found by Levenberg-Marquardt steps from a scan of all delays (variable projection: Golub and
Pereyra, SIAM J. Numer. Anal. 10(2), 1973). Errors are whitened by the noise's own filter, so that
their curvature gives the intervals (Ljung, System Identification, 2nd ed., chapter 9); where the
sum of squares is not quadratic within the interval, it is followed to its rise (profile
likelihood: Seber and Wild, Nonlinear Regression, section 5.4). All signals are normalised by their
own deviation first, so that no result depends on units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import (
    Array,
    Intersample,
    Mask,
    Trajectory,
    deviations,
    is_constant,
)
from asia.errors import UserError

T = TypeVar("T")

ROUNDING = 1e-10
"""Variance of the error, over that of the output, below which errors are rounding."""

# Samples that a fit takes from the records, from the first on.
_MOST_SAMPLES = 6_000
# Decrease of the Bayesian information criterion that an effect, an integrator, or a motion at the
# start must reach.
_EVIDENCE = 10.0
# Orders of the noise's filter; the shortest and longest lag, in samples and in record lengths.
_NOISE_ORDERS = (0, 1, 2, 4, 8)
_SHORTEST_LAG, _LONGEST_LAG = 0.05, 10.0
# Relative distance that equal lags are set apart by.
_APART = 2e-5
# Difference of the logarithms of two lags below which the sum of squares is not quadratic in each.
_ALIKE = 0.2
# Iterations of a fit, and lags that the scan compares.
_ITERATIONS, _SCANNED = 30, 12


@dataclass(frozen=True)
class ProcessStructure:
    """Form of the transfer function of one input."""

    lags: int
    zero: bool = False
    integrator: bool = False


_LARGER: dict[ProcessStructure, tuple[ProcessStructure, ...]] = {
    ProcessStructure(1): (ProcessStructure(2), ProcessStructure(2, True)),
    ProcessStructure(2): (ProcessStructure(2, True), ProcessStructure(3)),
    ProcessStructure(1, integrator=True): (
        ProcessStructure(2, integrator=True),
        ProcessStructure(2, True, True),
    ),
}


@dataclass(frozen=True)
class Interval:
    """Estimate with its standard error and 95 % interval."""

    value: float
    error: float
    low: float
    high: float
    lower: float = -math.inf
    """Least value that the fit searched."""
    upper: float = math.inf
    """Greatest value that the fit searched."""


@dataclass(frozen=True)
class InputTransfer:
    """Transfer function of one input, in physical units and samples."""

    structure: ProcessStructure
    gain: Interval
    """Output unit over input unit; with an integrator over samples too."""
    lags: tuple[Interval, ...]
    """Time constants in samples, the longest first."""
    zero: Interval | None
    """Time constant of the zero in samples."""
    delay: Interval
    """Dead time in samples."""
    first: int
    """Samples until the output responds; 0 for a direct feedthrough."""
    acts: bool
    """Whether the input explains more of the output than chance would."""


@dataclass(frozen=True)
class OutputTransfer:
    """Transfer functions of all inputs to one output."""

    inputs: tuple[InputTransfer | None, ...]
    """None for an input that does not move."""
    offset: float
    """Output at zero inputs; with an integrator its rate in samples."""
    at_rest: bool
    """Whether the records begin at rest."""
    fit: float
    """100 (1 - |error| / |output - mean|), in percent."""
    noise: float
    """Standard deviation of the error of simulation, in the output's unit."""
    adequate: bool
    """Whether the errors are independent of the inputs, up to chance, and below the output."""
    errors: tuple[Array, ...]
    """Measured minus simulated output (T,) of each record; nan where it was not measured."""
    innovations: tuple[Array, ...]
    """The same after the filter of the noise, over their deviation."""
    contributions: tuple[tuple[Array, ...], ...]
    """Simulated part (T,) of each input, by record."""
    between: tuple[Intersample, ...] = ()
    """Behaviour of each input between samples; () holds all."""


def fit_transfer(
    records: Sequence[Trajectory],
    output: int,
    structures: Sequence[ProcessStructure] | None = None,
    between: Sequence[Intersample | None] = (),
) -> OutputTransfer:
    """Fit transfer functions to the simulation error of an output.

    Args:
        records: training records in physical units
        output: column of the output
        structures: form for each input; None chooses each by the Bayesian information criterion
        between: behaviour of each input between samples, None where the criterion decides whether
            it is held or linear; () holds all. A band-limited input is taken as linear.

    Raises:
        UserError: for an output that does not change, and records that are too short
    """
    given = None if structures is None else tuple(structures)
    return _fitted(SameRecords(records), output, given, tuple(between))


class SameRecords:
    """Key that is equal for the identical record objects."""

    def __init__(self, records: Sequence[Trajectory]) -> None:
        self.records = tuple(records)

    def __hash__(self) -> int:
        return hash(tuple(map(id, self.records)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SameRecords) and (
            len(self.records) == len(other.records)
            and all(a is b for a, b in zip(self.records, other.records, strict=True))
        )


def once_for_records(
    analyse: Callable[[tuple[Trajectory, ...]], T],
) -> Callable[[Sequence[Trajectory]], T]:
    """Analyse records once for the same record objects."""
    analysis = lru_cache(maxsize=8)(lambda same: analyse(same.records))

    @wraps(analyse)
    def of_records(records: Sequence[Trajectory]) -> T:
        return analysis(SameRecords(records))

    return of_records


@lru_cache(maxsize=32)
def _fitted(
    same: SameRecords,
    output: int,
    structures: tuple[ProcessStructure, ...] | None,
    between: tuple[Intersample | None, ...],
) -> OutputTransfer:
    data, best = _searched(same, output, structures, tuple(kind or "zero" for kind in between))
    if None in between:
        kinds = tuple[Intersample, ...](kind or "first" for kind in between)
        other, moving = _searched(same, output, structures, kinds)
        held = data.on_rows_of(moving, best)
        if moving.criterion + _EVIDENCE < held.criterion:
            data, best = other, moving
    return data.described(best)


def _searched(
    same: SameRecords,
    output: int,
    structures: tuple[ProcessStructure, ...] | None,
    between: tuple[Intersample, ...],
) -> tuple[_Data, _State]:
    data = _Data(same.records, output, between)
    chosen = structures and tuple(structures[j] for j in data.moving)
    base = chosen or (ProcessStructure(1),) * len(data.moving)
    count = sum(s.lags + 2 + s.zero for s in base) + 1
    if data.samples < 4 * count or not data.moving:
        many = "s" if len(data.moving) != 1 else ""
        raise UserError(
            f"process model: {data.samples} samples are too few for {len(data.moving)} "
            f"moving input{many}"
        )
    best = data.start(base)
    if chosen is None:
        best = data.grown(best)
    return data, best


@dataclass(frozen=True)
class _State:
    """Point of a search."""

    structures: tuple[ProcessStructure, ...]
    phi: Array
    """Logarithms of the lags, then the delay in samples, of each input."""
    at_rest: bool
    skipped: int
    """Samples at the start of each record that inputs before it may reach."""
    noise: Array
    """Coefficients of the noise's filter, 1 first."""
    squares: float = math.inf
    """Sum of squares of the whitened errors."""
    rows: int = 0
    weights: int = 0
    """Number of linear weights."""

    @property
    def criterion(self) -> float:
        """Bayesian information criterion."""
        # Rounding passes the filter of the noise too.
        variance = self.squares / max(self.rows, 1) + ROUNDING * float(self.noise @ self.noise)
        count = len(self.phi) + self.weights
        return self.rows * math.log(variance) + count * math.log(max(self.rows, 2))

    def slices(self) -> list[slice]:
        """Places in phi of each input."""
        ends = np.cumsum([s.lags + 1 for s in self.structures]).tolist()
        return [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]


class _Data:
    """Normalised records of one output, and the regressions on them."""

    def __init__(
        self, records: Sequence[Trajectory], output: int, between: tuple[Intersample, ...]
    ) -> None:
        self.between = between
        kept: list[Trajectory] = []
        for record in records:
            left = _MOST_SAMPLES - sum(map(len, kept))
            if left > 8:
                kept.append(record[: min(len(record), left)])
        self.inputs = records[0].u.shape[1]
        self.whole = [(r.u, r.measured_y[:, output]) for r in records]
        u = np.concatenate([r.u for r in kept])
        seen = [r.measured[:, output] for r in kept]
        y = np.concatenate([r.y[s, output] for r, s in zip(kept, seen, strict=True)])
        self.samples = len(y)
        if is_constant(y):
            raise UserError("process model: the output does not change")
        self.moving = [j for j in range(self.inputs) if not is_constant(u[:, j])]
        self.u_mean, self.y_mean = u.mean(axis=0), float(y.mean())
        self.u_std = deviations(u)
        self.y_std = float((y - self.y_mean).std())
        scaled = [(r.u - self.u_mean) / self.u_std for r in kept]
        self.u = [v[:, self.moving] for v in scaled]
        self.y = [(r.y[:, output] - self.y_mean) / self.y_std for r in kept]
        self.seen = seen
        self.lengths = [len(v) for v in self.u]
        self.longest = max(self.lengths)
        ends = np.cumsum(self.lengths)[:-1].tolist()
        self._by_record = partial(np.split, indices_or_sections=ends)
        self.most_delay = self.longest / 3.0
        # Records side by side, so that they are filtered together.
        self._inside = np.arange(self.longest) < np.array(self.lengths)[:, None]
        self._time = np.concatenate([np.arange(n) for n in self.lengths])
        self._initial = np.repeat([v[0] for v in self.u], self.lengths, axis=0)
        self._moves = np.zeros((self.longest, len(self.u), len(self.moving)))
        for k, v in enumerate(self.u):
            self._moves[: len(v), k] = v - v[0]
        self._columns = lru_cache(maxsize=256)(self._input_columns)
        self._kept = lru_cache(maxsize=8)(self._measured_rows)

    # Regressors.

    def _input_columns(self, j: int, structure: ProcessStructure, phi: tuple[float, ...]) -> Array:
        """Outputs (rows, 1 or 2) of all records for unit weights of one input."""
        chain = _Chain(np.exp(np.array(phi[:-1])), structure, moving=self._is_linear(j))
        moved = chain.outputs(self._moves[:, :, j], *chain.filters(phi[-1]))
        first = self._initial[:, j]
        steady = first * (self._time if structure.integrator else 1.0)
        rest = [first * structure.integrator] * structure.zero
        pairs = zip(moved, [steady, *rest], strict=True)
        return np.stack([m.T[self._inside] + s for m, s in pairs], axis=1)

    def _is_linear(self, j: int) -> bool:
        """Whether a moving input is linear between samples."""
        return bool(self.between) and self.between[self.moving[j]] != "zero"

    def on_rows_of(self, other: _State, at: _State) -> _State:
        """A state with its squares on the rows and after the filter of another."""
        return self._solved(replace(at, noise=other.noise, skipped=other.skipped))[0]

    def _decays(self, at: _State) -> Array:
        """Free responses (longest, q) of the lags of all inputs."""
        time = np.arange(self.longest)
        lags = np.concatenate([np.exp(at.phi[s][:-1]) for s in at.slices()])
        return np.exp(-time[:, None] / lags)

    def _design(self, at: _State) -> tuple[Array, Array]:
        """Whitened regressors and outputs of all measured samples."""
        integrator = any(s.integrator for s in at.structures)
        forced = [
            self._columns(j, s, tuple(at.phi[p].tolist()))
            for j, (s, p) in enumerate(zip(at.structures, at.slices(), strict=True))
        ]
        own = np.ones((self.longest, 1 if integrator else 0))
        free = own if at.at_rest else np.hstack([own, self._decays(at)])
        width = free.shape[1]
        rest, block = list[Array](), np.zeros((sum(self.lengths), width * len(self.lengths)))
        for r, (rows, samples) in enumerate(zip(self._by_record(block), self.lengths, strict=True)):
            rest.append(np.arange(samples) / self.longest if integrator else np.ones(samples))
            rows[:, r * width : (r + 1) * width] = free[:samples]
        regressors = np.column_stack([*forced, np.concatenate(rest), block])
        return (
            self._white(regressors, at.skipped, at.noise),
            self._white(np.concatenate(self.y), at.skipped, at.noise),
        )

    def _white(self, values: Array, skipped: int, noise: Array) -> Array:
        """Filter the samples of all records and keep the rows whose samples were all measured."""
        made = values.copy()
        # Rows with samples of two records are not kept.
        for k, weight in enumerate(noise[1:], 1):
            made[k:] += weight * values[:-k]
        return made[self._kept(skipped, len(noise) - 1)]

    def _measured_rows(self, skipped: int, order: int) -> Mask:
        found: list[Mask] = []
        for seen in self.seen:
            used = seen & (np.arange(len(seen)) >= skipped)
            early = np.concatenate([np.zeros(order, bool), used])
            late = [early[order - k :][: len(used)] for k in range(order + 1)]
            found.append(np.logical_and.reduce(late))
        return np.concatenate(found)

    def _solved(self, at: _State) -> tuple[_State, Array, Array, Array, Array]:
        """The state with its squares, weights, errors, basis and singular scales."""
        x, y = self._design(at)
        scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
        basis, sizes, turn = np.linalg.svd(x / scale, full_matrices=False)
        good = sizes > 1e-10 * sizes[0]
        basis = basis[:, good]
        part = basis.T @ y
        weights = (turn[good].T @ (part / sizes[good])) / scale
        errors = y - basis @ part
        made = replace(at, squares=float(errors @ errors), rows=len(y), weights=x.shape[1])
        return made, weights, errors, basis, y

    def _slopes(self, at: _State, weights: Array) -> Array:
        """Derivatives (rows, P) of the simulated output by phi, weights held."""
        columns: list[Array] = []
        place = 0
        for j, (s, p) in enumerate(zip(at.structures, at.slices(), strict=True)):
            own = weights[place : place + 1 + s.zero]
            place += 1 + s.zero
            phi = at.phi[p]
            for k in range(len(phi)):
                step = 1e-4 if k < len(phi) - 1 else 1e-3
                ends = [phi.copy(), phi.copy()]
                ends[0][k] += step
                ends[1][k] -= step * (k < len(phi) - 1 or phi[k] >= step)
                a, b = (self._columns(j, s, tuple(e.tolist())) for e in ends)
                width = ends[0][k] - ends[1][k]
                columns.append(self._white((a - b) @ own / width, at.skipped, at.noise))
        return np.stack(columns, axis=1)

    # Search.

    def _bounds(self, at: _State) -> tuple[Array, Array]:
        low = np.concatenate([[*[math.log(_SHORTEST_LAG)] * s.lags, 0.0] for s in at.structures])
        most = math.log(_LONGEST_LAG * self.longest)
        high = np.concatenate([[*[most] * s.lags, self.most_delay] for s in at.structures])
        return low, high

    def improved(
        self,
        at: _State,
        iterations: int = _ITERATIONS,
        held: int | None = None,
        least: float = 1e-5,
    ) -> _State:
        """Levenberg-Marquardt steps until one gains less than a share, with one coordinate held
        where it is named."""
        low, high = self._bounds(at)
        here, weights, errors, basis, _ = self._solved(replace(at, phi=np.clip(at.phi, low, high)))
        damping = 1e-3
        for _ in range(iterations):
            slopes = self._slopes(here, weights)
            slopes = slopes - basis @ (basis.T @ slopes)
            free = np.ones(len(here.phi), dtype=bool)
            if held is not None:
                free[held] = False
            gradient = slopes.T @ errors
            free &= ~((here.phi <= low) & (gradient < 0)) & ~((here.phi >= high) & (gradient > 0))
            if not free.any():
                break
            part, pull = slopes[:, free], gradient[free]
            normal = part.T @ part
            size = np.maximum(np.diagonal(normal), 1e-14 * max(float(normal.max()), 1e-300))
            better = False
            for _ in range(8):
                move = np.zeros(len(here.phi))
                move[free] = np.linalg.lstsq(normal + damping * np.diag(size), pull, rcond=None)[0]
                move = np.clip(move, -2.0, 2.0 + 0.2 * self.most_delay)
                tried = replace(here, phi=np.clip(here.phi + move, low, high))
                solved = self._solved(tried)
                if solved[0].squares < here.squares:
                    gain = 1.0 - solved[0].squares / here.squares
                    here, weights, errors, basis, _ = solved
                    damping, better = max(damping / 5.0, 1e-9), gain > least
                    break
                damping *= 6.0
            if not better:
                break
        return here

    def _searched(self, starts: Sequence[_State]) -> _State:
        """Best end of several starts; each delay is moved by whole samples too."""
        quick = [self.improved(one, 4) for one in starts]
        here = self.improved(min(quick, key=lambda one: one.squares))
        places = here.slices()
        for place in (places[j].stop - 1 for j in self._by_effect(here)):
            for move in (-1.0, 1.0):
                phi = here.phi.copy()
                phi[place] += move
                if phi[place] < 0.0:
                    continue
                tried = self.improved(replace(here, phi=phi), 3)
                if tried.squares < here.squares * (1.0 - 1e-6):
                    here = self.improved(tried, 12)
        return here

    def _by_effect(self, at: _State) -> list[int]:
        """Numbers of the moving inputs, that with the largest effect first: no search depends on
        the order of the channels."""
        parts = self._parts(at, self._solved(at)[1])
        sizes = [float(np.concatenate(part).std()) for part in parts]
        return sorted(range(len(sizes)), key=lambda j: -sizes[j])

    def _whitened(self, at: _State) -> _State:
        """The state with the noise's filter estimated from its errors, then improved."""
        for _ in range(2):
            at = self.improved(replace(at, noise=self._noise_of(at)), 12)
        return at

    def _noise_of(self, at: _State) -> Array:
        """Coefficients of the autoregressive filter that whitens the errors, by least Bayesian
        information criterion."""
        plain = replace(at, noise=np.ones(1))
        # A constant that the present filter hides would pass for noise.
        errors, place, parts = self._solved(plain)[2], 0, list[Array]()
        for kept in self._by_record(self._kept(at.skipped, 0)):
            part = np.full(len(kept), np.nan)
            part[kept] = errors[place : place + int(kept.sum())]
            place += int(kept.sum())
            parts.append(part)
        best: tuple[float, Array] = (math.inf, np.ones(1))
        most = _NOISE_ORDERS[-1]
        rows = [np.lib.stride_tricks.sliding_window_view(p, most + 1) for p in parts
                if len(p) > most]  # fmt: skip
        lagged = np.concatenate(rows)[:, ::-1] if rows else np.zeros((0, most + 1))
        lagged = lagged[np.isfinite(lagged).all(axis=1)]
        if len(lagged) < max(40, self.samples // 2):
            return best[1]
        products = lagged.T @ lagged / len(lagged) + ROUNDING * np.eye(most + 1)
        for order in _NOISE_ORDERS:
            own = slice(1, order + 1)
            theta = np.linalg.lstsq(products[own, own], products[own, 0], rcond=1e-10)[0]
            variance = float(products[0, 0] - theta @ products[own, 0])
            value = len(lagged) * math.log(variance) + order * math.log(len(lagged))
            if value < best[0]:
                best = value, np.concatenate([[1.0], -theta])
        return best[1]

    def start(self, structures: tuple[ProcessStructure, ...]) -> _State:
        """Best fit of these structures, at rest or in motion at the start."""
        return self._moved(self._whitened(self._searched(self._from_scan(structures))))

    def _moved(self, here: _State) -> _State:
        """The state, or that of records in motion at the start where there is evidence for it."""
        states = sum(s.lags for s in here.structures)
        if not here.at_rest or min(self.lengths) <= 4 * (states + len(here.structures)):
            return here
        delays = [float(here.phi[p][-1]) for p in here.slices()]
        moving = replace(here, at_rest=False, skipped=math.ceil(max(delays)))
        if moving.skipped >= 0.5 * min(self.lengths):
            return here
        # Both are compared on the same rows.
        same = self._solved(replace(here, skipped=moving.skipped))[0]
        # The filter of the noise may hide a motion at the start.
        plain = [replace(one, noise=np.ones(1)) for one in (moving, same)]
        if self._solved(plain[0])[0].criterion < self._solved(plain[1])[0].criterion:
            moving = self._whitened(self._searched(plain[:1]))
            if moving.criterion < same.criterion - _EVIDENCE:
                return moving
        return here

    def _from_scan(self, structures: tuple[ProcessStructure, ...]) -> list[_State]:
        """Starts from the lag and delay of each input that explain most, one input at a time."""
        integrator = any(s.integrator for s in structures)
        shares = np.geomspace(0.4, max(self.longest / 3.0, 2.0), _SCANNED)
        lags, delays = np.full(len(structures), shares[0]), np.zeros(len(structures))
        simple = [replace(s, lags=1, zero=False) if s.lags else s for s in structures]
        parts: list[list[Array] | None] = [None] * len(structures)
        # The greatest first, then each again beside the others, in the same order.
        ranked: list[int] = []
        for turn in range(2 if len(structures) > 1 else 1):
            order = list(ranked or range(len(structures)))
            while order:
                candidates = order if turn == 0 else order[:1]
                others = [
                    p for k, p in enumerate(parts)
                    if p is not None and (turn == 0 or k != order[0])
                ]  # fmt: skip
                found = [
                    (self._scan(j, simple[j], shares, others, integrator=integrator), j)
                    for j in candidates
                ]
                (_, lag, delay), j = max(found, key=lambda f: f[0][0])
                lags[j], delays[j] = lag, delay
                phi = (math.log(lag), float(delay)) if simple[j].lags else (float(delay),)
                parts[j] = self._by_record(self._columns(j, simple[j], phi)[:, 0])
                order.remove(j)
                ranked += [j] * (turn == 0)

        def made(split: float) -> _State:
            phi: list[float] = []
            for s, lag, delay in zip(structures, lags, delays, strict=True):
                if s.lags <= 1 or split == 0.0:
                    small = [math.log(0.5)] * (s.lags - 1)
                    phi += [*[math.log(lag)] * min(s.lags, 1), *small, delay]
                else:
                    ratios = [1.0, split, 0.5 * split][: s.lags]
                    phi += [math.log(lag * q) for q in ratios]
                    phi.append(max(delay - lag * sum(ratios[1:]) * 0.5, 0.0))
            return _State(structures, np.array(phi), True, 0, np.ones(1))

        most = max(s.lags for s in structures)
        return [made(0.0)] if most <= 1 else [made(0.0), made(0.3), made(0.8)]

    def _scan(
        self,
        j: int,
        structure: ProcessStructure,
        shares: Array,
        others: Sequence[Sequence[Array]],
        *,
        integrator: bool,
    ) -> tuple[float, float, float]:
        """Explained sum of squares, lag and delay of an input beside fitted ones."""
        size = 1 << (2 * self.longest - 1).bit_length()
        most = int(self.most_delay)
        best = (-1.0, float(shares[0]), 0.0)
        # Spectra of what is explained, and of what the others explain, by record.
        spectra: list[tuple[NDArray[Any], NDArray[Any]]] = []
        for r, (y, seen) in enumerate(zip(self.y, self.seen, strict=True)):
            time = np.arange(len(y)) / self.longest
            x = (
                np.column_stack(
                    [np.ones(len(y)), *([time] if integrator else []), *(o[r] for o in others)]
                )
                * seen[:, None]
            )
            basis = np.linalg.qr(x)[0]
            target = np.where(seen, y, 0.0)
            left = target - basis @ (basis.T @ target)
            spectra.append((np.fft.rfft(left, size), np.fft.rfft(basis, size, axis=0)))
        for share in shares if structure.lags else shares[:1]:
            phi = (math.log(share), 0.0) if structure.lags else (0.0,)
            columns = self._by_record(self._columns(j, structure, phi)[:, 0])
            product, energy = np.zeros(most + 1), np.zeros(most + 1)
            for one, (target, basis) in zip(columns, spectra, strict=True):
                column = one - one[0]
                spectrum = np.fft.rfft(column, size).conj()
                product += np.fft.irfft(target * spectrum, size)[: most + 1]
                count = min(most + 1, len(column))
                kept = np.cumsum(column**2)[::-1]
                energy[:count] += kept[:count]
                shared = np.fft.irfft(basis * spectrum[:, None], size, axis=0)[: most + 1]
                energy -= (shared**2).sum(axis=1)
            whole = float(max(energy.max(), 1e-300))
            explained = np.where(energy > 1e-6 * whole, product**2 / np.maximum(energy, 1e-300), 0)
            place = int(np.argmax(explained))
            if explained[place] > best[0]:
                best = float(explained[place]), float(share), float(place)
        return best

    def grown(self, best: _State) -> _State:
        """Take larger structures for single inputs while the evidence asks for them."""
        best = self._integrated(best)
        refused: set[tuple[int, ProcessStructure]] = set()
        progress = True
        while progress:
            progress = False
            acting = self._acting(best)
            for j in self._by_effect(best):
                for larger in _LARGER.get(best.structures[j], ()):
                    if (j, larger) in refused or not acting[j]:
                        continue
                    tried = self._extended(best, j, larger)
                    refused.add((j, larger))
                    same = self._solved(replace(best, skipped=tried.skipped))[0]
                    if tried.criterion < same.criterion and self._resolved(tried, j):
                        best, progress = tried, True
                        break
        return best

    def _integrated(self, at: _State) -> _State:
        """Put an integrator in place of lags longer than half the longest record."""
        lags = [float(np.exp(at.phi[p][0])) for p in at.slices()]
        acting = self._acting(at)
        slow = [lag > 0.5 * self.longest and a for lag, a in zip(lags, acting, strict=True)]
        if not any(slow):
            return at
        structures = tuple(
            replace(s, integrator=True) if long else s
            for s, long in zip(at.structures, slow, strict=True)
        )
        tried = self.start(structures)
        rows = self._solved(replace(at, noise=tried.noise, skipped=tried.skipped))[0]
        return tried if tried.criterion < rows.criterion + _EVIDENCE else at

    def _extended(self, at: _State, j: int, larger: ProcessStructure) -> _State:
        structures = tuple(larger if k == j else s for k, s in enumerate(at.structures))
        places = at.slices()
        own = at.phi[places[j]]
        lags, delay = own[:-1], float(own[-1])
        starts: list[Array] = []
        extra = larger.lags - len(lags)
        if extra == 0:
            starts = [own]
        else:
            slowest = float(np.exp(lags.max()))
            for ratio in (0.0, 0.5):
                added = max(ratio * slowest, 0.5)
                kept = lags if ratio < 0.5 else np.where(lags == lags.max(), lags - 0.3, lags)
                starts.append(np.array(
                    [*kept, *[math.log(added)] * extra, max(delay - 0.6 * ratio * slowest, 0.0)]
                ))  # fmt: skip
        made = [
            np.concatenate([s if k == j else at.phi[p] for k, p in enumerate(places)])
            for s in starts
        ]
        # The filter of the smaller model takes its errors for noise.
        plain = replace(at, structures=structures, noise=np.ones(1))
        quick = [self.improved(replace(plain, phi=p), 5) for p in made]
        return self._moved(self._whitened(self.improved(min(quick, key=lambda one: one.squares))))

    def _resolved(self, at: _State, j: int) -> bool:
        """Whether the lags of an input are apart from their bounds and from its zero."""
        phi = at.phi[at.slices()[j]]
        lags = np.exp(phi[:-1])
        if lags.min() < 2.0 * _SHORTEST_LAG or lags.max() > 0.5 * _LONGEST_LAG * self.longest:
            return False
        if not at.structures[j].zero:
            return True
        weights = self._solved(at)[1]
        place = sum(1 + s.zero for s in at.structures[:j])
        zero = weights[place + 1] / weights[place] if weights[place] else math.inf
        return bool((np.abs(zero - lags) > 0.05 * lags).all())

    # Description.

    def described(self, at: _State) -> OutputTransfer:
        """Parameters in physical units with their intervals."""
        from scipy.special import stdtrit

        at = self.improved(at, least=1e-12)
        solved, weights, errors, _, _ = self._solved(at)
        slopes = self._slopes(solved, weights)
        x = self._design(at)[0]
        jacobian = np.hstack([slopes, x])
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        freedom = max(len(errors) - jacobian.shape[1], 1)
        variance = max(float(errors @ errors), 1e-24 * len(errors)) / freedom
        normal = (jacobian / scale).T @ (jacobian / scale)
        covariance = variance * np.linalg.pinv(normal, rcond=1e-13) / np.outer(scale, scale)
        factor = float(stdtrit(freedom, 0.975))
        low, high = self._bounds(at)
        ends = [
            self._interval(solved, covariance, k, factor, variance, (low[k], high[k]))
            for k in range(len(at.phi))
        ]
        size, place = len(at.phi), 0
        found: list[InputTransfer | None] = [None] * self.inputs
        parts, acting = self._parts(at, weights), self._acting(at)
        adequate = True
        for j, (s, p) in enumerate(zip(at.structures, at.slices(), strict=True)):
            unit = self.y_std / self.u_std[self.moving[j]]
            k = size + place
            gain, error = float(weights[place]), float(np.sqrt(max(covariance[k, k], 0.0)))
            zero = None
            if s.zero:
                value = float(weights[place + 1]) / gain
                slope = np.zeros(len(covariance))
                slope[k], slope[k + 1] = -value / gain, 1.0 / gain
                wide = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
                zero = Interval(value, wide, value - factor * wide, value + factor * wide)
            lags = [
                Interval(
                    float(np.exp(at.phi[i])),
                    float(np.exp(at.phi[i]) * np.sqrt(max(covariance[i, i], 0.0))),
                    math.exp(ends[i][0]),
                    math.exp(ends[i][1]),
                    math.exp(low[i]),
                    math.exp(high[i]),
                )
                for i in range(p.start, p.stop - 1)
            ]
            last = p.stop - 1
            delay = Interval(
                float(at.phi[last]),
                float(np.sqrt(max(covariance[last, last], 0.0))),
                ends[last][0],
                ends[last][1],
                0.0,
                self.most_delay,
            )
            first, fits = self._first(at, j, delay, weights, variance)
            adequate = adequate and fits
            found[self.moving[j]] = InputTransfer(
                s,
                Interval(gain * unit, error * abs(unit), *sorted(
                    ((gain - factor * error) * unit, (gain + factor * error) * unit))),
                tuple(sorted(lags, key=lambda one: -one.value)),
                zero, delay, first, acting[j],
            )  # fmt: skip
            place += 1 + s.zero
        return self._result(at, found, weights, place, parts, adequate=adequate)

    def _result(
        self,
        at: _State,
        found: Sequence[InputTransfer | None],
        weights: Array,
        place: int,
        parts: Sequence[Sequence[Array]],
        *,
        adequate: bool,
    ) -> OutputTransfer:
        integrator = any(s.integrator for s in at.structures)
        plain = self._design(replace(at, skipped=0, noise=np.ones(1)))[0] @ weights
        errors: list[Array] = []
        innovations: list[Array] = []
        start = 0
        from scipy.signal import lfilter

        white_rows = self._by_record(self._kept(at.skipped, len(at.noise) - 1))
        for y, seen, kept in zip(self.y, self.seen, white_rows, strict=True):
            simulated = np.full(len(y), np.nan)
            simulated[seen] = plain[start : start + int(seen.sum())]
            start += int(seen.sum())
            errors.append(np.where(seen, y - simulated, np.nan))
            white: Any = lfilter(at.noise, [1.0], np.where(seen, errors[-1], 0.0))
            white = np.where(kept, white, np.nan)
            innovations.append(white)
        used = np.concatenate(
            [np.where(np.arange(len(e)) >= at.skipped, e, np.nan) for e in errors]
        )
        spread = float(np.concatenate([y[s] for y, s in zip(self.y, self.seen, strict=True)]).std())
        size = float(np.sqrt(np.nanmean(used**2)))
        deviation = float(np.nanstd(np.concatenate(innovations))) or 1.0
        gains = np.array([0.0 if one is None else one.gain.value for one in found])
        rest = float(weights[place])
        if integrator:
            offset = rest / self.longest * self.y_std - float(gains @ self.u_mean)
        else:
            offset = self.y_mean + self.y_std * rest - float(gains @ self.u_mean)
        return OutputTransfer(
            tuple(found), offset, at.at_rest, 100.0 * (1.0 - size / max(spread, 1e-300)),
            size * self.y_std, adequate and size < spread,
            tuple(e * self.y_std for e in errors), tuple(e / deviation for e in innovations),
            tuple(tuple(p * self.y_std for p in part) for part in parts),
            self.between,
        )  # fmt: skip

    def _parts(self, at: _State, weights: Array) -> list[list[Array]]:
        """Simulated part of each moving input, by record."""
        found: list[list[Array]] = []
        place = 0
        for j, (s, p) in enumerate(zip(at.structures, at.slices(), strict=True)):
            columns = self._columns(j, s, tuple(at.phi[p].tolist()))
            found.append(self._by_record(columns @ weights[place : place + 1 + s.zero]))
            place += 1 + s.zero
        return found

    def _acting(self, at: _State) -> list[bool]:
        """Whether the criterion asks for each input, the others fitted anew in linear steps."""
        at, weights, _, _, y = self._solved(at)
        slopes, x = self._slopes(at, weights), self._design(at)[0]
        found: list[bool] = []
        start = 0
        for structure, place in zip(at.structures, at.slices(), strict=True):
            own = 1 + structure.zero
            others = np.hstack([
                np.delete(x, range(start, start + own), axis=1),
                np.delete(slopes, range(place.start, place.stop), axis=1),
            ])  # fmt: skip
            start += own
            basis = np.linalg.qr(others / np.maximum(np.linalg.norm(others, axis=0), 1e-300))[0]
            left = y - basis @ (basis.T @ y)
            ratio = (float(left @ left) / len(y) + ROUNDING) / (at.squares / len(y) + ROUNDING)
            count = own + place.stop - place.start
            found.append(len(y) * math.log(ratio) > count * math.log(len(y)) + _EVIDENCE)
        return found

    def _interval(
        self,
        at: _State,
        covariance: Array,
        k: int,
        factor: float,
        variance: float,
        bounds: tuple[float, float],
    ) -> tuple[float, float]:
        """95 % interval of a coordinate: by the curvature where the sum of squares rises as it
        says, else where the profile rises by as much. Nearly equal lags have no curvature apart."""
        error = float(np.sqrt(max(covariance[k, k], 0.0)))
        own = next(p for p in at.slices() if p.start <= k < p.stop)
        lags = at.phi[own.start : own.stop - 1]
        alike = k < own.stop - 1 and int((np.abs(lags - at.phi[k]) < _ALIKE).sum()) > 1
        ends: list[float] = []
        size = len(at.phi)
        rise = factor**2 * variance
        for sign, bound in ((-1.0, bounds[0]), (1.0, bounds[1])):
            plain = at.phi[k] + sign * factor * error
            if error > 0 and not alike and (plain - bound) * sign <= 0:
                move = covariance[:size, k] / covariance[k, k] * sign * factor * error
                low, high = self._bounds(at)
                phi = at.phi + move
                if ((phi >= low - 1e-9) & (phi <= high + 1e-9)).all():
                    there = self._solved(replace(at, phi=np.clip(phi, low, high)))[0]
                    ratio = (there.squares - at.squares) / rise
                    if 0.9 < ratio < 1.5:
                        ends.append(float(plain))
                        continue
            ends.append(self._profile(at, k, sign, bound, rise, factor * error))
        return ends[0], ends[1]

    def _profile(
        self, at: _State, k: int, sign: float, bound: float, rise: float, step: float
    ) -> float:
        """Where the least sum of squares over all others rises enough; the bound without."""
        step = min(max(step, 1e-4), abs(bound - at.phi[k]))
        inside, outside, here = float(at.phi[k]), None, at
        for _ in range(7):
            value = inside + sign * step
            if (value - bound) * sign >= 0:
                value = bound
            phi = here.phi.copy()
            phi[k] = value
            tried = self.improved(replace(here, phi=phi), 4, held=k)
            if tried.squares - at.squares > rise:
                outside = value
                break
            if value == bound:
                return bound
            inside, here, step = value, tried, 2.0 * step
        if outside is None:
            return bound
        for _ in range(5):
            value = 0.5 * (inside + outside)
            phi = here.phi.copy()
            phi[k] = value
            tried = self.improved(replace(here, phi=phi), 4, held=k)
            if tried.squares - at.squares > rise:
                outside = value
            else:
                inside, here = value, tried
        return 0.5 * (inside + outside)

    def _first(
        self, at: _State, j: int, delay: Interval, weights: Array, variance: float
    ) -> tuple[int, bool]:
        """Samples until the output responds, and whether free leading coefficients agree with the
        transfer function.

        The coefficients around the delay are estimated freely beside the tail of the transfer
        function: one before it that exceeds its error comes first, and one of the transfer function
        that the free estimate contradicts does not count.
        """
        structure, place = at.structures[j], at.slices()[j]
        late = delay.value + min(2.0 * delay.error, 0.5)
        if structure.lags == 0 and not structure.integrator:
            return round(delay.value), True
        first = math.floor(late + 1e-9) + (not self._is_linear(j))
        window = list(range(max(first - 3, 0), first + 3))
        start = sum(1 + s.zero for s in at.structures[:j])
        own = weights[start : start + 1 + structure.zero]
        impulse = (
            _Chain(np.exp(at.phi[place][:-1]), structure, moving=self._is_linear(j)).impulse(
                float(at.phi[place][-1]), window[-1] + 2
            )
            @ own
        )
        x, y = self._design(at)
        lagged = [
            [np.concatenate([np.zeros(k), u[: len(u) - k, j] - u[0, j]])[: len(u)] for u in self.u]
            for k in window
        ]
        free = self._white(np.stack([np.concatenate(c) for c in lagged], 1), at.skipped, at.noise)
        head = free @ impulse[window]
        model = x[:, start : start + 1 + structure.zero] @ own - head
        others = np.delete(x, range(start, start + 1 + structure.zero), axis=1)
        matrix = np.column_stack([free, model, others])
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        inverse = np.linalg.pinv((matrix / scale).T @ (matrix / scale), rcond=1e-12)
        estimate = (inverse @ ((matrix / scale).T @ y)) / scale
        left = y - matrix @ estimate
        noise = max(float(left @ left) / max(len(y) - len(estimate), 1), 1e-24)
        error = np.sqrt(np.maximum(noise * np.diagonal(inverse), 0.0)) / scale
        fits = True
        for i, k in enumerate(window):
            value, wide = estimate[i], max(error[i], 1e-300)
            if k < first:
                if abs(value) > 4.0 * wide and abs(value) > 0.02 * float(np.abs(impulse).max()):
                    return k, False
                continue
            apart, size = abs(value - impulse[k]) / wide, abs(value) / wide
            fits = fits and bool(apart < 4.0)
            # One that does not exceed its error does not count where the next one clearly does.
            clear = i + 1 < len(window) and abs(estimate[i + 1]) > 4.0 * error[i + 1]
            small = max(abs(value), abs(impulse[k])) <= 2.0 * wide
            if apart**2 - size**2 < 4.0 and not (small and clear):
                return k, fits
        return first, fits


class _Chain:
    """Outputs of lags, and an integrator, for inputs that are held or, `moving`, linear between
    samples. Time is in samples."""

    def __init__(self, lags: Array, structure: ProcessStructure, *, moving: bool) -> None:
        # Without lags and integrator the output has the values of the input at samples alone.
        self.moving = moving and bool(len(lags) or structure.integrator)
        # Equal lags are set apart: partial fractions need it, and the effect is of second order.
        apart = np.sort(lags)
        for k in range(1, len(apart)):
            least = apart[k - 1] * (1.0 + _APART)
            if apart[k] < least:
                middle = 0.5 * (apart[k] + apart[k - 1])
                apart[k - 1], apart[k] = middle * (1.0 - _APART), middle * (1.0 + _APART)
        self.lags, self.structure = apart, structure
        self.shares = np.array(
            [np.prod([a / (a - b) for b in apart if b is not a and b != a]) for a in apart]
        )
        self.denominator = np.ones(1)
        for pole in [*np.exp(-1.0 / apart), *[1.0] * structure.integrator]:
            self.denominator = np.convolve(self.denominator, [1.0, -pole])

    def step(self, time: Array) -> list[Array]:
        """Step response at these times, and its derivative where there is a zero."""
        later = np.maximum(time, 0.0)
        decays = np.exp(-later[:, None] / self.lags) * self.shares
        if self.structure.integrator:
            rise, slope = later - self.lags.sum() + decays @ self.lags, 1.0 - decays.sum(axis=1)
        else:
            rise, slope = 1.0 - decays.sum(axis=1), decays @ (1.0 / self.lags)
        # Without lags the output moves with the input.
        still = time < 0.0 if not len(self.lags) else time <= 0.0
        found = [rise, slope] if self.structure.zero else [rise]
        return [np.where(still, 0.0, one) for one in found]

    def _ramp(self, time: Array) -> list[Array]:
        """Integrals of `step`."""
        later = np.maximum(time, 0.0)
        rise = self.step(time)[0]
        part = (1.0 - np.exp(-later[:, None] / self.lags)) * self.shares
        if self.structure.integrator:
            ramp = later * (0.5 * later - self.lags.sum()) + part @ self.lags**2
        else:
            ramp = later - part @ self.lags
        return [ramp, rise] if self.structure.zero else [ramp]

    def impulse(self, delay: float, samples: int) -> Array:
        """Responses (samples, 1 or 2) to an input that is 1 at one sample and 0 at the others."""
        late = float(round(delay)) if not len(self.lags) else delay
        if self.moving:
            ramps = self._ramp(np.arange(-1.0, samples + 1.0) - late)
            return np.stack([np.diff(one, 2) for one in ramps], axis=1)
        steps = self.step(np.arange(-1.0, samples) - late)
        return np.stack([np.diff(one) for one in steps], axis=1)

    def filters(self, delay: float) -> tuple[int, list[Array]]:
        """Whole samples of the delay, and numerators over the denominator for its rest, one for
        each row of C."""
        whole = round(delay) if not len(self.lags) else int(delay)
        order = len(self.denominator)
        responses = self.impulse(delay - whole, order + 2).T
        return whole, [np.convolve(self.denominator, r)[: order + 1] for r in responses]

    def outputs(self, u: Array, whole: int, numerators: Sequence[Array]) -> list[Array]:
        """Outputs for inputs (T, R), one for each numerator, from rest."""
        from scipy.signal import lfilter

        late = np.concatenate([np.zeros((whole, *u.shape[1:])), u])[: len(u)]
        filtered = [lfilter(b, self.denominator, late, axis=0) for b in numerators]
        return [np.asarray(one, np.float64) for one in filtered]
