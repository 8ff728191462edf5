"""Linear systems with static functions in feedback: regressors, starts, fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._arrays import tree_size
from asia.models._config import Progress
from asia.models._least_squares import LevenbergMarquardt, solve_or_fit
from asia.models._linear.fit import LinearFit
from asia.models._linear.system import LinearSystem
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData, ScaledTrajectory
from asia.models._reuse import reused
from asia.models._state_space.fit import StateFit, fit_states, of_records
from asia.models._state_space.model import LINEAR_RIDGE, FittedStateSpace
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._state_space.training import fit_segments, judge_fit, stability_term

if TYPE_CHECKING:
    from asia.models.nl_lfr import Config

# Search for the regressors of static functions in feedback, by the residual of the linear model.
#
# They are searched among inputs, outputs, combinations of them and of the states. The states are
# those of the linear model, and those of an observer that corrects them by the measured output, so
# that a function in a loop is read at the true state of the system. For given signals the
# functions and the places where they act follow by least squares, so that many regressors can be
# evaluated.

# Samples for the evaluation of regressors, random signals tried, best ones varied, and the size of
# the variation in each round.
_EVALUATED, _DRAWN, _KEPT, _ROUNDS, _VARIED = 3000, 80, 4, (0.5, 0.25, 0.12), 10
# Sets of regressors evaluated together, and the greatest size of their arrays.
_BATCH, _NUMBERS = 16, 3e7
# Ridge of the functions' weights, relative to the size of their factors.
_RIDGE = 1e-4
# Assumed sensor noise of the observer, as a share of the output's variance, in addition to the
# model's error.
_SENSOR = 0.01
# Least correlation of signals that count as equal.
_ALIKE = 0.97
# Relative size below which a direction of the linear terms is rounding.
RANK = 1e-7


class Reading(NamedTuple):
    """Regressors of the functions, with the error that they leave."""

    directions: Array  # (n + nu, m)
    observed: bool  # The states are the observer's
    error: float  # Mean squared error that remains


class PreparedRecord(NamedTuple):
    """Record prepared for the evaluation of regressors."""

    x0: Array  # Initial state (n,) of the linear model
    u: Array  # (T, nu)
    states: tuple[Array, Array]  # (T, n), by the linear model and by the observer
    residual: Array  # Residual (T, ny) of the linear model
    terms: Array  # Effects (T ny, p) of B, D, the offset and the initial state; see `_linear_terms`
    basis: Array  # Orthonormal basis (T ny, q) of `terms`
    weight: Array  # (T, ny)

    def read(self, directions: Array, observed: bool) -> Array:
        """Signals (T, m) in directions (n - integrators + nu, m)."""
        some = len(directions) - self.u.shape[1]
        return self.states[observed][:, :some] @ directions[:some] + self.u @ directions[some:]


def prepared_records(records: ScaledData, found: LinearFit) -> list[PreparedRecord]:
    """Prepare the first samples of each record."""
    each, system = max(_EVALUATED // len(records), 200), found.system
    some = list(zip(records, found.x0, strict=True))[: max(_EVALUATED // 200, 1)]
    prepared: list[PreparedRecord] = []
    for record, x0 in some:
        r = record.part(0, min(each, len(record)))
        states, outputs = (part[0] for part in system.simulate(x0[None], r.u[None]))
        residual = (r.y - outputs) * r.weight
        observed = _observed(system, x0, r, float(np.mean(residual**2)))
        terms = _linear_terms(system, r)
        basis = orthonormal(terms)
        prepared.append(
            PreparedRecord(x0, r.u, (states, observed), residual, terms, basis, r.weight)
        )
    return prepared


def _observed(system: LinearSystem, x0: Array, record: ScaledTrajectory, error: float) -> Array:
    """States (T, n) of a Kalman filter that attributes most of the error to a disturbance of the
    states."""
    from scipy.linalg import solve_discrete_are  # loading takes long

    n, ny = system.order, len(system.c)
    wander = max(error, 1e-9) * (system.b @ system.b.T + 1e-3 * np.eye(n))
    noise = (_SENSOR * error + 1e-6) * np.eye(ny)
    try:
        p = solve_discrete_are(system.a.T, system.c.T, wander, noise)
    except (np.linalg.LinAlgError, ValueError):
        return system.simulate(x0[None], record.u[None])[0][0]
    gain = p @ system.c.T @ np.linalg.inv(system.c @ p @ system.c.T + noise)
    states, x = np.empty((len(record), n)), x0
    for k in range(len(record)):
        wrong = record.y[k] - system.c @ x - system.d @ record.u[k] - system.offset
        x = x + gain @ (record.weight[k] * wrong)
        states[k] = x
        x = system.a @ x + system.b @ record.u[k]
    return states


def state_responses(system: LinearSystem, signals: Array) -> Array:
    """Outputs (T, ny, s, n) to signals (T, s) that act on each state."""
    # The outputs to one signal on every state are the states of the dual system.
    c, n = system.c[:, None, :], system.order
    drive = np.empty((len(c), signals.shape[1], n))
    found = np.zeros((len(signals), len(c) * signals.shape[1], n))
    for k in range(1, len(signals)):
        np.multiply(signals[k - 1][:, None], c, out=drive)
        np.matmul(found[k - 1], system.a, out=found[k])
        found[k] += drive.reshape(-1, n)
    return found.reshape(len(signals), *drive.shape)


def responses(system: LinearSystem, signals: Array) -> Array:
    """Outputs (T, ny, s, n + ny) to signals (T, s) that act on each state and on each output."""
    direct = signals[:, None, :, None] * np.eye(len(system.c))[:, None, :]
    return np.concatenate([state_responses(system, signals), direct], axis=-1)


def _linear_terms(system: LinearSystem, record: ScaledTrajectory) -> Array:
    """Effects (T ny, n nu + ny nu + ny + n) of B, D, the offset and the initial state on the
    outputs."""
    length, n, ny = len(record), system.order, len(system.c)
    forced = responses(system, record.u).reshape(length * ny, -1)
    constant = np.tile(np.eye(ny), (length, 1))
    free = system.simulate(np.eye(n), np.zeros((n, length, record.u.shape[1])))[1] - system.offset
    columns = np.hstack([forced, constant, free.transpose(1, 2, 0).reshape(length * ny, n)])
    return columns * record.weight.reshape(-1, 1)


def orthonormal(columns: Array) -> Array:
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, sizes > RANK * sizes[0]]


class RegressorSearch:
    """Search for the regressors of one fit."""

    def __init__(
        self,
        structure: StateSpaceStructure,
        system: LinearSystem,
        records: Sequence[PreparedRecord],
        rng: np.random.Generator,
    ) -> None:
        self.structure, self.system, self.records, self.rng = structure, system, records, rng
        self.m = structure.channels or 1
        # Number of states that may be read: a drifting state visits each level only once.
        self.free = structure.order - structure.integrators
        # Common random units of all regressors, so that only the regressors differ.
        self.drawn = rng.standard_normal((self.m, structure.hidden)), rng.random(structure.hidden)

    def best(self, count: int, observed: bool) -> list[Reading]:
        """Best regressors that differ from each other, the least error first."""
        pool = self.evaluated([(d, observed) for d in self._known()])
        for size in _ROUNDS:
            pool.sort(key=lambda r: r.error)
            kept = self._different(pool, _KEPT)
            moved = [
                (self._varied(r.directions, size), r.observed) for r in kept for _ in range(_VARIED)
            ]
            pool = [*kept, *self.evaluated(moved)]
        pool.sort(key=lambda r: r.error)
        return self._different(pool, count)

    def _known(self) -> list[Array]:
        """Directions that systems often have (inputs, outputs, and those that change an output),
        and random ones."""
        n, nu, s = self.structure.order, self.structure.nu, self.system
        change = np.hstack([s.c @ (s.a - np.eye(n)), s.c @ s.b])
        rows = np.vstack([np.eye(n + nu), np.hstack([s.c, s.d]), change])
        rows = np.delete(rows, range(self.free, n), axis=1)
        rows = rows[np.abs(rows).sum(axis=1) > 0]
        if self.m == 1:
            found = [row[:, None] for row in rows]
        else:
            pairs = [
                self.rng.choice(len(rows), self.m, replace=False) for _ in range(3 * len(rows))
            ]
            found = [rows[p].T for p in pairs]
        size = (self.free + nu, self.m)
        return found + [
            self.rng.standard_normal(size) / self._sizes()[:, None] for _ in range(_DRAWN)
        ]

    def _sizes(self) -> Array:
        states = np.concatenate([r.states[0][:, : self.free] for r in self.records])
        spread = np.hstack(
            [states.std(axis=0), np.concatenate([r.u for r in self.records]).std(axis=0)]
        )
        return np.where(spread > 1e-9, spread, 1.0)

    def _varied(self, directions: Array, size: float) -> Array:
        sizes = self._sizes()[:, None]
        unit = directions * sizes
        unit = unit / np.linalg.norm(unit, axis=0)
        return (unit + size * self.rng.standard_normal(unit.shape)) / sizes

    def _different(self, pool: Sequence[Reading], count: int) -> list[Reading]:
        chosen: list[tuple[Reading, Array]] = []
        for regressors in pool:
            z = self._read(regressors.directions, regressors.observed)
            z = (z - z.mean(axis=0)) / z.std(axis=0)
            alike = (np.linalg.svd(z.T @ other / len(z))[1].min() > _ALIKE for _, other in chosen)
            if not any(alike):
                chosen.append((regressors, z))
            if len(chosen) == count:
                break
        return [regressors for regressors, _ in chosen]

    def evaluated(self, candidates: Sequence[tuple[Array, bool]]) -> list[Reading]:
        """Evaluate regressors; those without any variation are left out."""
        found: list[Reading] = []
        s, longest = self.structure, max(len(r.u) for r in self.records)
        each = longest * s.ny * s.hidden * (s.order + s.ny)
        batch = int(np.clip(_NUMBERS / each, 1, _BATCH))
        for first in range(0, len(candidates), batch):
            part: list[tuple[Array, bool, dict[str, Array]]] = []
            for directions, observed in candidates[first : first + batch]:
                size = self._read(directions, observed).std(axis=0)
                if (size >= 1e-9).all() and np.isfinite(size).all():
                    scaled = directions / size
                    part.append((scaled, observed, self.layer(scaled, observed)))
            for (d, o, _), (gram, rhs, power) in zip(part, self.normal(part), strict=True):
                weights = solve_or_fit(gram, rhs)
                found.append(Reading(d, o, power - float(rhs @ weights)))
        return [r for r in found if np.isfinite(r.error)]

    def _read(self, directions: Array, observed: bool) -> Array:
        """Signals (T, m) of all records."""
        return np.concatenate([r.read(directions, observed) for r in self.records])

    def layer(self, directions: Array, observed: bool) -> dict[str, Array]:
        """Weights w1 (m, h) and b1 (h,) of units that cover the range of the signals."""
        z = self._read(directions, observed)
        h, (normal, uniform) = self.structure.hidden, self.drawn
        if self.m == 1:
            centres = np.quantile(z[:, 0], np.linspace(0.03, 0.97, h))[:, None]
            gaps = (centres[-1, 0] - centres[0, 0]) / max(h - 1, 1)
            w1 = np.full((1, h), 1.0 / max(gaps, 1e-3))
        else:
            centres = z[(uniform * len(z)).astype(int)]
            w1 = normal * (1.5 / np.linalg.norm(normal, axis=0))
        return {"w1": w1, "b1": -(centres * w1.T).sum(axis=1)}

    def normal(
        self, candidates: Sequence[tuple[Array, bool, dict[str, Array]]]
    ) -> list[tuple[Array, Array, float]]:
        """Normal equations of each set of regressors: Gram matrix (h (n + ny), ...) with ridge,
        right-hand side and the mean square of the residual to explain."""
        if not candidates:
            return []
        h, n, ny = self.structure.hidden, self.structure.order, self.structure.ny
        size = h * (n + ny)
        grams = [np.zeros((size, size)) for _ in candidates]
        sides = [np.zeros(size) for _ in candidates]
        power, samples = 0.0, 0
        for r in self.records:
            units = [self.structure.units(layer, r.read(d, o)) for d, o, layer in candidates]
            rest = r.residual.ravel()
            rest = rest - r.basis @ (r.basis.T @ rest)
            power, samples = power + float(rest @ rest), samples + len(rest)
            on_states = state_responses(self.system, np.hstack(units))
            on_states *= r.weight[..., None, None]
            on_states = on_states.reshape(len(rest), -1)
            for i, unit in enumerate(units):
                # Columns of signals on states, and of the same signals on each of the outputs.
                columns = on_states[:, i * h * n : (i + 1) * h * n]
                signals = [unit * r.weight[:, o, None] for o in range(ny)]
                known = r.basis.T @ columns
                side = np.empty((h, n + ny))
                gram = np.zeros((h, n + ny, h, n + ny))
                side[:, :n] = (columns.T @ rest).reshape(h, n)
                gram[:, :n, :, :n] = (columns.T @ columns - known.T @ known).reshape(h, n, h, n)
                direct = [r.basis[o::ny].T @ signals[o] for o in range(ny)]
                for o in range(ny):
                    side[:, n + o] = signals[o].T @ rest[o::ny]
                    both = columns[o::ny].T @ signals[o] - known.T @ direct[o]
                    gram[:, :n, :, n + o] = both.reshape(h, n, h)
                    gram[:, n + o, :, :n] = both.reshape(h, n, h).transpose(2, 0, 1)
                    gram[:, n + o, :, n + o] = signals[o].T @ signals[o]
                    for other in range(ny):
                        gram[:, n + o, :, n + other] -= direct[o].T @ direct[other]
                grams[i] += gram.reshape(size, size)
                sides[i] += side.ravel()
        mean = [np.trace(g) / size for g in grams]
        return [
            ((g + _RIDGE * m * np.eye(size)) / samples, s / samples, power / samples)
            for g, m, s in zip(grams, mean, sides, strict=True)
        ]


# Starts of a linear system with static functions in feedback, inferred from the linear model.
#
# The residual of the best linear model is explained by static functions of a few signals that act
# on its states and outputs. Sources: Schoukens and Toth, On the initialization of nonlinear LFR
# model identification with the best linear approximation, IFAC 2020; Floren, Noel and Swevers,
# Inference and learning of nonlinear LFR state-space models, arXiv 2503.14409.

_ALTERNATIONS = 15
# Shares of the functions that are tried.
_SCALES = (1.0, 0.5, 0.2)


def feedback_starts(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    count: int,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Find up to `count` starting points whose functions read different signals, the best first."""
    search = RegressorSearch(structure, found.system, prepared_records(records, found), rng)
    starts, by_error = _Starts(search), itemgetter(0)
    # Signals read from the observer explain an output by itself, so starts with both kinds of
    # states are simulated and compared.
    each = [
        sorted(starts.started(search.best(count, observed)), key=by_error)
        for observed in (False, True)
    ]
    first = sorted((some[0] for some in each if some), key=by_error)
    later = sorted((one for some in each for one in some[1:]), key=by_error)
    return [params for _, params in [*first, *later][:count]]


class _Starts:
    """Starting points of one fit."""

    def __init__(self, search: RegressorSearch) -> None:
        self.search, self.structure, self.system = search, search.structure, search.system

    def started(self, readings: Sequence[Reading]) -> list[tuple[float, dict[str, Any]]]:
        """Make a starting point of each reading: the share of the functions that simulates best,
        with its linear terms; return the errors of their simulations, and their parameters."""
        tried: list[dict[str, Any]] = []
        for regressors in readings:
            layer = self.search.layer(regressors.directions, regressors.observed)
            ((gram, rhs, _),) = self.search.normal(
                [(regressors.directions, regressors.observed, layer)]
            )
            w2, act = self._factors(gram, rhs)
            for scale in _SCALES:
                moved = self._moved(regressors, layer, scale * w2 @ act)
                params = self.structure.start(moved, self.search.rng)
                function = {**layer, "w2": scale * w2}
                tried.append(params | {"read": regressors.directions, "act": act, "f": function})
        if not tried:
            return []
        errors = self._errors(tried).reshape(len(readings), -1)
        places = errors.argmin(axis=1) + np.arange(len(readings)) * len(_SCALES)
        return [(float(errors.flat[i]), tried[i]) for i in places]

    def _moved(self, regressors: Reading, layer: dict[str, Array], theta: Array) -> LinearSystem:
        """Linear system that goes with functions of weights theta (h, n + ny)."""
        s, nu = self.system, self.structure.nu
        n, ny = s.order, len(s.c)
        some = (n + ny) * nu + ny
        gram, side = np.zeros((some, some)), np.zeros(some)
        for r in self.search.records:
            signals = r.read(regressors.directions, regressors.observed)
            units = self.structure.units(layer, signals)
            both = responses(s, units @ theta)
            # Signal i acts only on state or output i.
            explained = np.einsum("tyii->ty", both) * r.weight
            rest, start = (r.residual - explained).ravel(), orthonormal(r.terms[:, some:])
            terms = r.terms[:, :some]
            terms = terms - start @ (start.T @ terms)
            gram, side = gram + terms.T @ terms, side + terms.T @ rest
        found = np.linalg.lstsq(gram, side, rcond=RANK)[0]
        change = found[: (n + ny) * nu].reshape(nu, n + ny).T
        return LinearSystem(
            s.a, s.b + change[:n], s.c, s.d + change[n:], s.offset + found[some - ny :]
        )

    def _errors(self, tried: Sequence[dict[str, Any]]) -> Array:
        """Sums of squared errors (K,) of simulations from the best initial states for the linear
        system, all K side by side."""
        total, n, count = np.zeros(len(tried)), self.structure.order, len(tried)

        def stacked(values: Sequence[Any]) -> Any:
            if isinstance(values[0], dict):
                return {name: stacked([v[name] for v in values]) for name in values[0]}
            return np.stack([np.atleast_2d(v) for v in values])

        params = stacked(tried)
        with np.errstate(all="ignore"):
            for r in self.search.records:
                x0 = np.tile(r.x0, (count, 1, 1))
                u = np.tile(r.u[:, None], (count, 1, 1, 1))
                y = self.structure.simulate(params, x0, u)[1][:, :, 0]
                line = self.system.simulate(r.x0[None], r.u[None])[1][0]
                rest = r.residual - (y - line) * r.weight
                rest = rest.reshape(count, -1)
                start = orthonormal(r.terms[:, -n:])
                rest = rest - rest @ start @ start.T
                total += (rest**2).sum(axis=1)
        return np.where(np.isfinite(total), total, np.inf)

    def _factors(self, gram: Array, rhs: Array) -> tuple[Array, Array]:
        """Last layer (h, m) and effects of the functions (m, n + ny), by alternating least
        squares."""
        h, n_act, m = self.structure.hidden, self.structure.order + self.structure.ny, self.search.m
        theta = solve_or_fit(gram, rhs).reshape(h, n_act)
        left, sizes, right = np.linalg.svd(theta, full_matrices=False)
        m = min(m, len(sizes))
        act, g4 = right[:m], gram.reshape(h, n_act, h, n_act)
        w2, side = left[:, :m] * sizes[:m], rhs.reshape(h, n_act)
        for _ in range(_ALTERNATIONS):
            g = np.einsum("kilj,ai,bj->kalb", g4, act, act).reshape(h * m, h * m)
            b = np.einsum("ki,ai->ka", side, act).ravel()
            w2 = np.linalg.lstsq(g, b, rcond=1e-12)[0].reshape(h, m)
            g = np.einsum("kilj,ka,lb->aibj", g4, w2, w2).reshape(m * n_act, m * n_act)
            b = np.einsum("ki,ka->ai", side, w2).ravel()
            act = np.linalg.lstsq(g, b, rcond=1e-12)[0].reshape(m, n_act)
        size = np.linalg.norm(act, axis=1)
        size = np.where(size > 1e-12, size, 1.0)
        w2, act = w2 * size, act / size[:, None]
        if m < self.search.m:
            w2 = np.pad(w2, ((0, 0), (0, self.search.m - m)))
            act = np.vstack(
                [act, self.search.rng.standard_normal((self.search.m - m, n_act)) / np.sqrt(n_act)]
            )
        return w2, act


# Fits of linear systems with static functions in feedback, from several linear models.

_LINEAR, _FUNCTIONS = ("a", "b", "c", "d", "offset"), ("f", "read", "act")
# Share of the iterations that every start gets, and number of starts that are continued.
_TRIED, _GO_ON = 0.25, 2
# Lengths of the segments that a fit begins with; it goes on with whole records.
_LENGTHS = 3
# Samples up to which compiling a program takes longer than running it with more states.
_WIDENED = 10_000


class LinearCore(NamedTuple):
    """Linear model that fits begin with."""

    found: LinearFit  # Fitted model
    delay: int  # Delay of its inputs, in samples
    records: ScaledData  # Records of its fit, inputs delayed


@dataclass(frozen=True)
class _Widening:
    """States without effect that are added before the integrators, so that models of several orders
    share compiled programs. They stay without effect: all derivatives by their entries are zero."""

    structure: StateSpaceStructure  # Model without them
    more: int  # Number of added states

    @property
    def wide(self) -> StateSpaceStructure:
        """Model with them."""
        return replace(self.structure, order=self.structure.order + self.more)

    def widened(self, params: dict[str, Any]) -> dict[str, Any]:
        """Parameters, or initial states "x0", with zeros for the added states."""
        at = [self.structure.order - self.structure.integrators] * self.more
        return {
            name: self._along(name, value, lambda v, axis: np.insert(v, at, 0.0, axis=axis))
            for name, value in params.items()
        }

    def system(self, system: LinearSystem) -> LinearSystem:
        """The linear system with them."""
        at = [self.structure.order - self.structure.integrators] * self.more
        a = np.insert(np.insert(system.a, at, 0.0, axis=0), at, 0.0, axis=1)
        b, c = np.insert(system.b, at, 0.0, axis=0), np.insert(system.c, at, 0.0, axis=1)
        return replace(system, a=a, b=b, c=c)

    def narrowed(self, fit: StateFit) -> StateFit:
        """A fit without the added states."""
        first = self.structure.order - self.structure.integrators
        gone = range(first, first + self.more)
        params = {
            name: self._along(name, value, lambda v, axis: np.delete(v, gone, axis=axis))
            for name, value in {**fit.params, "x0": fit.x0}.items()
        }
        return fit._replace(x0=params.pop("x0"), params=params)

    @staticmethod
    def _along(name: str, value: Any, change: Callable[[Array, int], Array]) -> Any:
        """Change each axis of a parameter that counts states."""
        axes = {"a": (0, 1), "b": (1,), "c": (0,), "read": (0,), "act": (1,), "x0": (1,)}
        for axis in axes.get(name, ()):
            value = change(value, axis)
        return value


class _Fit(NamedTuple):
    """Unfinished fit."""

    core: LinearCore
    structure: StateSpaceStructure
    start: dict[str, Any]
    now: StateFit
    penalty: float  # Factor of Akaike's final prediction error, which penalises further states

    @property
    def expected_error(self) -> float:
        """Estimate of the error on new records."""
        return self.now.cost * self.penalty


def fit_feedback(
    cores: Sequence[LinearCore],
    options: Config,
    scaling: Scaling,
    context: Context,
    method: LevenbergMarquardt,
) -> FittedStateSpace:
    """Best of the fits from `method.starts` starts for each linear model."""
    fits = _Fits(options, context, method, max(core.found.system.order for core in cores))
    tried = sorted(
        (one for core in cores for one in fits.begun(core)), key=lambda t: t.expected_error
    )[:_GO_ON]
    if options.pieces:
        # One start begins with whole records, since segments may mislead too.
        first = tried[0]
        whole = StateFit(first.core.found.x0, first.start, np.inf, np.zeros(0))
        tried.append(fits.fitted(first.core, first.structure, first.start, whole, fits.first))
    ended = (fits.fitted(one.core, one.structure, one.start, one.now, fits.rest) for one in tried)
    finished = [
        (one, judge_fit(one.structure, one.now, one.core.records, context, True)) for one in ended
    ]
    best, found = min(finished, key=lambda pair: pair[0].penalty * pair[1].error)
    return FittedStateSpace(
        best.structure, found.params, found.encoder, best.core.delay, scaling,
        past_fit=found.past_fit,
    )  # fmt: skip


class _Fits:
    """Fits of one model, with their common settings."""

    def __init__(
        self, options: Config, context: Context, method: LevenbergMarquardt, largest: int
    ) -> None:
        """largest: greatest order of the linear models."""
        self.options, self.context, self.method = options, context, method
        self.largest = largest
        first = max(1, round(_TRIED * method.iterations))
        self.first = replace(method, iterations=first, noise_model="white")
        self.rest = replace(method, iterations=max(0, method.iterations - first))

    def begun(self, core: LinearCore) -> list[_Fit]:
        """Run the first iterations from each start, on whole records or on short segments."""
        o, order = self.options, core.found.system.order
        structure = StateSpaceStructure(
            order, self.context.nu, self.context.ny, "state", "multiquadric", o.hidden, 2,
            o.channels, integrators=o.integrators,
        )  # fmt: skip
        count, seed = self.method.starts, self.context.seed

        def search(_: Progress) -> list[dict[str, Any]]:
            rng = np.random.default_rng(seed)
            return feedback_starts(structure, core.found, core.records, count, rng)

        given = structure, core.found, core.records, count, seed
        starts = reused("feedback", given, search, self.context.log)
        if not self.options.pieces:
            begin = [StateFit(core.found.x0, start, np.inf, np.zeros(0)) for start in starts]
            both = zip(starts, begin, strict=True)
            return [self.fitted(core, structure, s, b, self.first) for s, b in both]
        both = _Widening(structure, self.largest - order)
        wide = fit_segments(
            both.wide, both.system(core.found.system), [both.widened(start) for start in starts],
            core.records, both.widened({"x0": core.found.x0})["x0"], self._ridges(core),
            self.first, self.context.log, self.context.sampling_time, _LENGTHS,
        )  # fmt: skip
        return [
            _fit(core, structure, start, both.narrowed(one))
            for start, one in zip(starts, wide, strict=True)
        ]

    def _ridges(self, core: LinearCore) -> dict[str, float]:
        ridge = dict.fromkeys(_LINEAR, LINEAR_RIDGE)
        ridge |= dict.fromkeys(_FUNCTIONS, self.options.ridge)
        return {**ridge, "x0": core.found.error / sum(len(r) for r in core.records)}

    def fitted(
        self,
        core: LinearCore,
        structure: StateSpaceStructure,
        start: dict[str, Any],
        now: StateFit,
        method: LevenbergMarquardt,
    ) -> _Fit:
        """Continue a fit; the ridge holds it to its start."""
        short = sum(len(r) for r in core.records) <= _WIDENED
        both = _Widening(structure, self.largest - structure.order if short else 0)
        samples = of_records(core.records, both.widened({"x0": core.found.x0})["x0"])
        wide = fit_states(
            both.wide, [both.widened(start)], samples, self._ridges(core), method,
            self.context.log, self.context.sampling_time, [both.widened(now.params)],
            [both.widened({"x0": now.x0})["x0"]],
            stability_term(core.found, self.options.integrators, core.records),
        )[0]  # fmt: skip
        return _fit(core, structure, start, both.narrowed(wide))


def _fit(
    core: LinearCore, structure: StateSpaceStructure, start: dict[str, Any], now: StateFit
) -> _Fit:
    count = sum(float(r.weight.sum()) for r in core.records)
    p = min(float(tree_size(now.params)), 0.9 * count)
    return _Fit(core, structure, start, now, (count + p) / (count - p))
