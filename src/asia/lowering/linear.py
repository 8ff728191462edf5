"""Linear model of a lowered model at an operating point: matrices, poles, reduction, continuous
time, process model.

A step x' = f(x, u), y = h(x, u) has the operating points x = f(x, u). The matrices are exact
derivatives there. Sources: Ljung, System Identification, 2nd ed., section 4; Skogestad and
Postlethwaite, Multivariable Feedback Control, 2nd ed., chapter 11 (balanced truncation and its
error bound); Seborg et al., Process Dynamics and Control, chapter 5 (process models).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia._plugins import library
from asia.data.trajectory import Array, Intersample
from asia.errors import UserError
from asia.lowering.derivatives import derivatives, jacobian
from asia.lowering.evaluation import evaluate
from asia.lowering.program import LoweredModel

ComplexArray: TypeAlias = NDArray[np.complex128]
# Hankel singular values below this share of the largest one belong to states without effect.
_NEGLIGIBLE = 1e-9
# Share of the largest coefficient of a transfer function below which the first ones are rounding.
_ROUNDING = 1e-9
# Distance of a pole from 1 at which the linear model counts as an integrator.
_INTEGRATOR = 1e-6
# Size of a discrete pole below which it holds past samples, within the error of a multiple
# eigenvalue, and has no time constant.
_NO_DYNAMICS = 1e-3
# Samples of an impulse response.
_IMPULSE = 2_000
_SETTLING, _NEWTON = 20_000, 50
# Relative error of a process model at which no larger one is tried.
_CLOSE = 1e-3


@dataclass(frozen=True)
class LinearModel:
    """x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k], for deviations from an operating point."""

    a: Array
    b: Array
    c: Array
    d: Array
    sampling_time: float
    """In s; 0 for continuous time."""
    u0: Array
    """Inputs (nu,) of the operating point."""
    y0: Array
    """Outputs (ny,) of the operating point."""
    inputs: tuple[Intersample, ...] = ()
    """Behaviour of each input between samples; () holds all."""

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues (n,) of A, complex, the slowest first."""
        found = np.asarray(np.linalg.eigvals(self.a), np.complex128)
        if self.sampling_time:
            found[np.abs(found) < _NO_DYNAMICS] = 0.0
        size = np.real(found) if self.sampling_time == 0 else np.abs(found)
        return found[np.argsort(-size, kind="stable")]

    def _normalised(self) -> tuple[list[Array], Array]:
        """A, B, C and D in units of the rate and of the signals, so that rounding is alike in all
        units; and the units (ny, nu) of the response."""
        sizes = [np.linalg.norm(self.b, axis=0), np.linalg.norm(self.c, axis=1)]
        into, out = (np.where(one > 0, one, 1.0) for one in sizes)
        unit = np.outer(out, into) / self._rate
        return [self.a / self._rate, self.b / into, self.c / out[:, None], self.d / unit], unit

    @property
    def zeros(self) -> ComplexArray:
        """Invariant zeros, complex, the smallest first, of a system with as many inputs as outputs;
        else empty."""
        if not self.b.shape[1] == len(self.c) > 0:
            return np.zeros(0, np.complex128)
        from scipy.linalg import eig

        n, ((a, b, c, d), _) = self.order, self._normalised()
        pencil = np.block([[a, b], [c, d]])
        mass = np.zeros_like(pencil)
        mass[:n, :n] = np.eye(n)
        found = np.asarray(eig(pencil, mass, right=False), np.complex128)
        found = self._rate * found[np.isfinite(found) & (np.abs(found) < 1e8)]
        return found[np.lexsort((-found.imag, np.abs(found).round(12)))]

    @property
    def gain(self) -> Array:
        """Static gain (ny, nu); infinite with an integrator."""
        if self.is_integrating:
            return np.full_like(self.d, np.inf)
        rest = -self.a if self.sampling_time == 0 else np.eye(self.order) - self.a
        return self.c @ np.linalg.solve(rest, self.b) + self.d

    @property
    def is_unstable(self) -> bool:
        """Whether a mode grows, by more than an integrator does."""
        if not self.sampling_time:
            return bool((np.real(self.poles) > _INTEGRATOR * self._rate).any())
        return bool((np.abs(self.poles) > 1.0 + _INTEGRATOR).any())

    @property
    def _rate(self) -> float:
        """Size that poles are compared with: 1 of a discrete model, the fastest of another."""
        return 1.0 if self.sampling_time else float(np.abs(self.poles).max(initial=0.0)) or 1.0

    def integrates(self, pole: complex) -> bool:
        """Return whether a pole is an integrator."""
        return abs(pole - (1.0 if self.sampling_time else 0.0)) < _INTEGRATOR * self._rate

    @property
    def is_integrating(self) -> bool:
        """Whether a pole is an integrator."""
        return any(map(self.integrates, self.poles.tolist()))

    @property
    def slope_gain(self) -> Array:
        """Slope (ny, nu) of the outputs in 1/s after a unit step, by the real pole nearest to an
        integrator."""
        from scipy.linalg import eig

        if not self.order:
            return np.zeros_like(self.d)
        found: Any = eig(self.a, left=True, right=True)
        poles, left, right = found
        place = int(np.argmin(np.abs(poles - (1.0 if self.sampling_time else 0.0))))
        w, v = left[:, place].conj(), right[:, place]
        residue = np.outer(self.c @ v, w @ self.b) / (w @ v)
        return np.real(residue) / (self.sampling_time or 1.0)

    @property
    def delay(self) -> Array:
        """Samples (ny, nu) before an input acts on an output; -1 where it never does."""
        found, part = np.full(self.d.shape, -1), self.b
        responses = [self.d]
        for _ in range(self.order + 1):
            responses.append(self.c @ part)
            part = self.a @ part
        # Relative to the responses of the same output, and of the same input.
        sizes = np.abs(responses).max(axis=0)
        rows = np.maximum(sizes.max(axis=1, keepdims=True, initial=0.0), 1e-300)
        scale = rows * (sizes / rows).max(axis=0, keepdims=True, initial=0.0)
        for k, one in reversed(list(enumerate(responses))):
            found[np.abs(one) > 1e-9 * scale] = k
        return found

    def modes(self) -> list[tuple[complex, float, float, float]]:
        """Pole, frequency [Hz], damping ratio and time constant [s] of each mode; a complex pair
        is one mode. nan where a discrete pole at or below 0 has none."""
        found: list[tuple[complex, float, float, float]] = []
        for pole in self.poles:
            if pole.imag < 0:
                continue
            if self.sampling_time and pole.imag == 0 and pole.real <= 0:
                found.append((complex(pole), math.nan, math.nan, math.nan))
                continue
            s = np.log(pole) / self.sampling_time if self.sampling_time else pole
            size = abs(s)
            damping = -s.real / size if size > 0 else 0.0
            constant = -1.0 / s.real if abs(s.real) > 1e-300 else math.inf
            found.append((complex(pole), size / (2 * math.pi), float(damping), float(constant)))
        return found

    def mode_shares(self) -> list[float]:
        """Part of each mode of `modes` in the step response over the largest part of a mode, for
        the input and output where this is greatest: 0 where a zero cancels the pole; nan of a pole
        without dynamics, whose modes rounding decides."""
        from scipy.linalg import eig

        if not self.order:
            return []
        found: Any = eig(self.a, left=True, right=True)
        poles, left, right = found
        sizes: list[Array] = []
        if self.sampling_time:
            moves = np.abs(poles) >= _NO_DYNAMICS
            poles, left, right = poles[moves], left[:, moves], right[:, moves]
        for k, pole in enumerate(poles):
            w, v = left[:, k].conj(), right[:, k]
            rest = abs(pole - 1.0) if self.sampling_time else abs(pole)
            norm = max(abs(w @ v) * max(rest, _INTEGRATOR * self._rate), 1e-300)
            sizes.append(np.abs(np.outer(self.c @ v, w @ self.b)) / norm)
        largest = np.maximum(np.max([*sizes, np.abs(self.d)], axis=0), 1e-300)
        shares = [float((one / largest).max(initial=0.0)) for one in sizes]
        return [
            math.nan if self.sampling_time and not pole
            else shares[int(np.argmin(np.abs(poles - pole)))]
            for pole, *_ in self.modes()
        ]  # fmt: skip

    def response(self, frequencies: Array) -> ComplexArray:
        """Frequency response (F, ny, nu) at `frequencies` in Hz, complex."""
        s = 2j * math.pi * np.asarray(frequencies)
        z = np.exp(s * self.sampling_time) if self.sampling_time else s
        eye = np.eye(self.order)
        return np.stack(
            [self.c @ np.linalg.solve(one * eye - self.a, self.b) + self.d for one in z]
        )

    def scaled(self, u: Array, y: Array) -> Self:
        """The model of inputs and outputs in units of these sizes (nu,) and (ny,)."""
        b, c, d = self.b * u, self.c / y[:, None], self.d * u / y[:, None]
        return replace(self, b=b, c=c, d=d, u0=self.u0 / u, y0=self.y0 / y)

    def step_response(self, samples: int) -> Array:
        """Response (samples, ny, nu) of a discrete model to a unit step of each input."""
        x, found = np.zeros(self.b.shape), np.empty((samples, *self.d.shape))
        for k in range(samples):
            found[k] = self.c @ x + self.d
            x = self.a @ x + self.b
        return found

    def simulate(self, u: Array) -> Array:
        """Outputs (T, ny) of a discrete model from rest, for inputs u (T, nu) as they are."""
        x, found = np.zeros(self.order), np.empty((len(u), len(self.c)))
        for k, moved in enumerate(u - self.u0):
            found[k] = self.y0 + self.c @ x + self.d @ moved
            x = self.a @ x + self.b @ moved
        return found

    def control(self, inputs: Sequence[str], outputs: Sequence[str]) -> Any:
        """The same as `control.StateSpace`. Raises UserError where python-control is missing."""
        try:
            control = library("control")
        except ImportError:
            raise UserError("python-control is missing: pip install control") from None
        return control.ss(
            self.a, self.b, self.c, self.d, self.sampling_time or 0,
            inputs=[name.replace(".", "_") for name in inputs],
            outputs=[f"{n}_out" if n in inputs else n.replace(".", "_") for n in outputs],
        )  # fmt: skip

    def numerator(self) -> tuple[list[Array], Array]:
        """Transfer functions of all inputs to all outputs: numerators, one array (nu, n + 1) an
        output, and the common denominator (n + 1,), the highest power first. Coefficients of the
        size of rounding are 0."""
        from scipy.signal import ss2tf

        (a, b, c, d), unit = self._normalised()
        # Coefficients have the unit of a power of the rate. Slow modes make the last ones small.
        powers = self._rate ** np.arange(self.order + 1.0)
        least = _ROUNDING / 1e3 if self.sampling_time else 0.0

        def cleaned(values: Array) -> Array:
            size = np.abs(values) / max(float(np.abs(values).max()), 1e-300)
            first = np.maximum.accumulate(size) > _ROUNDING
            return np.where(first & (size > least), values, 0.0)

        found = [ss2tf(a, b, c, d, j) for j in range(b.shape[1])]
        numerators = [
            np.stack([cleaned(np.atleast_2d(num)[i]) for num, _ in found])
            * unit[i][:, None] * powers
            for i in range(len(c))
        ]  # fmt: skip
        return numerators, cleaned(np.asarray(found[0][1])) * powers


# Operating points.


@dataclass(frozen=True)
class OperatingPoint:
    """Constant states, inputs and outputs of a model."""

    x: Array
    u: Array
    y: Array
    residual: float
    """Largest change of a state in one step, relative to the size of the states."""


def joined(parts: Sequence[Array]) -> Array:
    """States as one vector (n,)."""
    return np.concatenate([np.reshape(part, -1) for part in parts]) if parts else np.zeros(0)


def split(model: LoweredModel, x: Array) -> list[Array]:
    """The states of a model from one vector (n,)."""
    ends = np.cumsum([math.prod(shape) for shape in model.states])[:-1]
    return [p.reshape(s) for p, s in zip(np.split(x, ends), model.states, strict=True)]


def settle(
    model: LoweredModel, x: Array, u: Array, samples: int = _SETTLING, change: float = 1e-13
) -> Array:
    """State (n,) after a constant input; ended early where it is not finite, and where a step
    changes it by less than the share `change`."""
    size = np.abs(x)
    for _ in range(samples):
        after = joined(evaluate(model.update, [*split(model, x), u]))
        if not np.isfinite(after).all():
            return x
        size = np.maximum(size, np.abs(after))
        if (np.abs(after - x) <= change * size).all():
            return after
        x = after
    return x


def operating_points(
    model: LoweredModel, starts: Sequence[Array], u: Array, y: Array | None = None
) -> list[OperatingPoint]:
    """Operating points that are found from several states, each once.

    Args:
        starts: states (n,) to settle from
        u: constant inputs (nu,); with `y` a first guess of them
        y: outputs (ny,) that the operating point has; None: the inputs are given

    Returns:
        the points where the states rest; empty where there is none (an integrator, a limit cycle)
    """
    found: list[OperatingPoint] = []
    n, sloped = sum(math.prod(shape) for shape in model.states), jacobian(model.step)

    def newton(x: Array) -> tuple[Array, Array]:
        """State and inputs that solve the equations of rest, from a state on."""
        inputs = np.array(u, np.float64)
        for _ in range(_NEWTON):
            outputs, *states, slopes = evaluate(sloped, [*split(model, x), inputs])
            wrong = joined(states) - x
            matrix = slopes[model.ny :] - np.eye(n, n + model.nu)
            if y is None:
                matrix = matrix[:, :n]
            else:
                wrong = np.concatenate([wrong, (outputs - y) / level])
                matrix = np.vstack([matrix, slopes[: model.ny] / level[:, None]])
            # States and inputs have units of their own.
            units = np.linalg.norm(matrix, axis=0)
            units[units == 0.0] = 1.0
            move = np.linalg.lstsq(matrix / units, -wrong, rcond=1e-12)[0] / units
            if not np.isfinite(move).all():
                break
            x = x + move[:n]
            inputs = inputs if y is None else inputs + move[n:]
            if (np.abs(move[:n]) <= 1e-12 * np.abs(x)).all():
                break
        return x, inputs

    # The states and outputs that the operating points are compared with.
    size = np.abs(starts).max(axis=0, initial=0.0)
    level = np.abs(
        [evaluate(model.step, [*split(model, one), u])[0] for one in starts]
        + ([] if y is None else [y])
    ).max(axis=0)
    level[level == 0.0] = 1.0
    for start in starts:
        x, inputs = start, np.array(u, np.float64)
        # Newton's method ends the settling, unless it leads away from where that goes.
        for change in (1e-6, 1e-13):
            settled = settle(model, start, u, change=change)
            x, inputs = newton(settled)
            largest = max(size.max(initial=0.0), np.abs(settled).max(initial=0.0))
            if y is not None or np.abs(x - settled).max(initial=0.0) <= 0.01 * largest:
                break
            start = settled
        outputs, *after = evaluate(model.step, [*split(model, x), inputs])
        own = np.maximum(size, np.abs(x))
        rest = _share(joined(after) - x, np.maximum(own, 1e-9 * own.max(initial=0.0)))
        off = 0.0 if y is None else _share(outputs - y, level)
        point = OperatingPoint(x, inputs, outputs, max(rest, off))
        known = any(
            np.allclose(one.y, point.y, 1e-4, 1e-6 * level)
            and np.allclose(one.u, point.u, 1e-4, 1e-6 * np.abs(u))
            for one in found
        )
        if np.isfinite(x).all() and point.residual <= 1e-7 and not known:
            found.append(point)
    return found


def _share(values: Array, sizes: Array) -> float:
    """Largest value relative to its size; a value without a size counts as it is."""
    return float((np.abs(values) / np.where(sizes > 0, sizes, 1.0)).max(initial=0.0))


def linearised(model: LoweredModel, point: OperatingPoint, sampling_time: float) -> LinearModel:
    """Exact derivatives of a step at a point, without the states that have no effect."""
    n, ny = len(point.x), model.ny
    _, slopes = derivatives(model.step, [*split(model, point.x), point.u])
    full = LinearModel(
        slopes[ny:, :n], slopes[ny:, n:], slopes[:ny, :n], slopes[:ny, n:], sampling_time,
        point.u, point.y,
    )  # fmt: skip
    return minimal(full)


# Fewer states.


def minimal(model: LinearModel) -> LinearModel:
    """The same input-output behaviour without states that no input reaches or no output shows."""

    def reachable(a: Array, b: Array) -> Array:
        """Orthonormal basis (n, r) of the states that the inputs reach."""
        # Each signal counts by its own unit.
        sizes = np.abs(b).max(axis=0, initial=0.0)
        basis, part = np.zeros((len(a), 0)), b / np.where(sizes > 0, sizes, 1.0)
        while part.size and basis.shape[1] < len(a):
            part = part - basis @ (basis.T @ part)
            part = part - basis @ (basis.T @ part)
            left, sizes, _ = np.linalg.svd(part, full_matrices=False)
            new = left[:, sizes > _NEGLIGIBLE * max(1.0, float(sizes.max(initial=0.0)))]
            basis, part = np.hstack([basis, new]), a @ new
        return basis

    t = reachable(model.a, model.b)
    a, b, c = t.T @ model.a @ t, t.T @ model.b, model.c @ t
    t = reachable(a.T, c.T)
    return replace(model, a=t.T @ a @ t, b=t.T @ b, c=c @ t)


@dataclass(frozen=True)
class Reduction:
    """A model of fewer states."""

    model: LinearModel
    singular_values: Array
    """Hankel singular values (n,) of the stable part, the largest first."""
    bound: float
    """Twice the sum of those left out: no frequency response differs more."""


def reduced(model: LinearModel, order: int | None = None, tolerance: float = 0.01) -> Reduction:
    """Balanced truncation of the stable part; unstable modes and integrators are kept.

    Args:
        order: states of the result; None: the fewest with a bound below `tolerance` times the
            largest singular value

    Raises:
        UserError: for an order below the number of unstable modes, or above that of the model
    """
    from scipy.linalg import cholesky, schur, solve_discrete_lyapunov, solve_sylvester

    limit = 1.0 - _INTEGRATOR
    ordered: Any = schur(
        model.a, output="real", sort=lambda re, im=0.0: bool(np.hypot(re, im) < limit)
    )
    triangular, turned, stable = ordered
    kept = model.order - int(stable)
    if order is not None and not kept <= order <= model.order:
        raise UserError(
            f"--reduce {order}: the model has {model.order} states, {kept} of them unstable or "
            f"integrating: give {kept} to {model.order}"
        )
    s = int(stable)
    # Block diagonal: stable modes first.
    coupling = solve_sylvester(triangular[:s, :s], -triangular[s:, s:], -triangular[:s, s:])
    into = turned @ np.block([[np.eye(s), coupling], [np.zeros((kept, s)), np.eye(kept)]])
    b, c = np.linalg.solve(into, model.b), model.c @ into
    a1, b1, c1 = triangular[:s, :s], b[:s], c[:, :s]
    a2, b2, c2 = triangular[s:, s:], b[s:], c[:, s:]
    eye = 1e-15 * np.eye(s)

    def factor(gramian: Array) -> Array:
        scale = max(float(np.trace(gramian)) / max(s, 1), 1e-300)
        found = cholesky((gramian + gramian.T) / 2 + scale * eye, lower=True)
        return np.asarray(found, np.float64)

    if s:
        reach = factor(np.asarray(solve_discrete_lyapunov(a1, b1 @ b1.T), np.float64))
        show = factor(np.asarray(solve_discrete_lyapunov(a1.T, c1.T @ c1), np.float64))
        left, sizes, right = np.linalg.svd(show.T @ reach)
    else:
        reach = show = left = right = np.zeros((0, 0))
        sizes = np.zeros(0)
    tails = [2.0 * float(sizes[k:].sum()) for k in range(s + 1)]
    if order is None:
        few = next(k for k in range(s + 1) if tails[k] <= tolerance * sizes.max(initial=0.0))
    else:
        few = order - kept
    root = 1.0 / np.sqrt(sizes[:few])
    t, inverse = reach @ right[:few].T * root, (show @ left[:, :few] * root).T
    a = np.block([
        [inverse @ a1 @ t, np.zeros((few, kept))],
        [np.zeros((kept, few)), a2],
    ])  # fmt: skip
    found = replace(model, a=a, b=np.vstack([inverse @ b1, b2]), c=np.hstack([c1 @ t, c2]))
    return Reduction(found, sizes, tails[few])


# Continuous time.


def continuous(model: LinearModel, tolerance: float = 0.0) -> tuple[LinearModel, int]:
    """The continuous-time model whose equivalent this is, for the behaviour of its inputs between
    samples, after a common dead time. Source: Franklin, Powell and Workman, Digital Control of
    Dynamic Systems, 3rd ed., section 6.3 (first-order hold).

    Args:
        tolerance: largest change of the impulse response, as a share of its sum, in leaving out
            modes that no continuous system gives

    Returns:
        the model, and the dead time in samples

    Raises:
        UserError: where there is none: poles at or on the negative real axis
    """
    from scipy.linalg import expm, logm

    moving = np.array([kind != "zero" for kind in model.inputs or ("zero",) * model.b.shape[1]])
    # A held input acts one sample late.
    delays = (model.delay - ~moving)[model.delay >= 0]
    dead = max(int(delays.min()), 0) if delays.size else 0
    if dead:
        first, power = (np.linalg.matrix_power(model.a, k) for k in (dead - 1, dead))
        d = np.where(moving, model.c @ first @ model.b, model.d)
        model = minimal(replace(model, b=power @ model.b, d=d))
    if _has_no_rate(model.poles).any():
        slow = _without_fast_modes(model, tolerance) if tolerance else None
        if slow is None:
            raise UserError(
                "there is no continuous-time model: a pole lies at 0 or on the negative real axis, "
                "which no continuous system with such inputs gives"
            )
        model, dead = slow[0], dead + slow[1]
    n, m, step = model.order, model.b.shape[1], model.sampling_time
    whole = np.block([[model.a, model.b], [np.zeros((m, n)), np.eye(m)]])
    rate = np.asarray(np.real(np.asarray(logm(whole))), np.float64) / step
    found = replace(model, a=rate[:n, :n], b=rate[:n, n:], sampling_time=0.0)
    if moving.any():
        # Effects of a step and of a ramp on the states within a sample.
        chain = np.zeros((3 * n, 3 * n))
        chain[:n, :n], chain[:n, n : 2 * n] = step * found.a, step * np.eye(n)
        chain[n : 2 * n, 2 * n :] = np.eye(n)
        _, held, ramp = np.hsplit(np.asarray(expm(chain), np.float64)[:n], 3)
        both = model.a @ ramp + held - ramp
        b = np.where(moving, np.linalg.solve(both, model.b), found.b)
        found = replace(found, b=b, d=np.where(moving, model.d - model.c @ ramp @ b, model.d))
    return found, dead


def _has_no_rate(poles: ComplexArray) -> NDArray[np.bool_]:
    return np.asarray((np.abs(poles.imag) < 1e-9) & (poles.real <= 1e-12))


def _without_fast_modes(model: LinearModel, tolerance: float) -> tuple[LinearModel, int] | None:
    """The model without its modes at 0 and on the negative real axis after a dead time in samples
    that replaces them best; None where its impulse response would change by more."""
    from scipy.linalg import schur, solve_sylvester

    ordered: Any = schur(
        model.a, output="real", sort=lambda re, im=0.0: not (abs(im) < 1e-9 and re <= 1e-12)
    )
    triangular, turned, kept = ordered
    k, n = int(kept), model.order
    if not k:
        return None
    away = solve_sylvester(triangular[:k, :k], -triangular[k:, k:], -triangular[:k, k:])
    into = turned @ np.block([[np.eye(k), away], [np.zeros((n - k, k)), np.eye(n - k)]])
    a, b, c = triangular[:k, :k], np.linalg.solve(into, model.b)[:k], (model.c @ into)[:, :k]

    def impulse(a: Array, x: Array, c: Array) -> Array:
        found = np.empty((_IMPULSE, len(c), x.shape[1]))
        for row in found:
            row[:] = c @ x
            x = a @ x
        return found

    whole, slow = impulse(model.a, model.b, model.c), impulse(a, b, c)
    late = range(2 * (n - k) + 1)
    errors = [np.abs(whole[:dead]).sum() + np.abs(whole - slow)[dead:].sum() for dead in late]
    dead = int(np.argmin(errors))
    if not errors[dead] <= tolerance * np.abs(whole).sum():
        return None
    return replace(model, a=a, b=np.linalg.matrix_power(a, dead) @ b, c=c), dead


# Process model.


@dataclass(frozen=True)
class ProcessModel:
    """K (1 + Tz s) e^(-L s) / (s^i (1 + T1 s) ...)."""

    gain: float
    lags: tuple[float, ...]
    """Time constants in s, the longest first."""
    zero: float
    """Tz in s; 0 without a zero."""
    delay: float
    """L in s."""
    integrator: bool
    fit: float
    """100 (1 - |error| / |response - mean|) % of the step response."""

    def __str__(self) -> str:
        above = "" if self.zero == 0 else f" (1 + {self.zero:.4g} s)"
        dead = "" if self.delay == 0 else f" exp(-{self.delay:.4g} s)"
        below = ["s"] * self.integrator + [f"(1 + {lag:.4g} s)" for lag in self.lags]
        text = " ".join(below)
        return f"{self.gain:.4g}{above}{dead} / {f'({text})' if len(below) > 1 else text}"

    def step(self, t: Array) -> Array:
        """Response to a unit step at times t in s."""
        return _step(t, self.gain, self.lags, self.zero, self.delay, integrator=self.integrator)


def _step(
    t: Array, gain: float, lags: Sequence[float], zero: float, delay: float, *, integrator: bool
) -> Array:
    """Step response by partial fractions; equal lags are set apart a little."""
    lags = sorted(lags, reverse=True)
    apart = [lag * (1.0 + 1e-4 * k) for k, lag in enumerate(lags)]
    time = np.maximum(t - delay, 0.0)
    total = time + zero - sum(apart) if integrator else np.ones_like(time)
    for i, lag in enumerate(apart):
        others = math.prod(1.0 - other / lag for j, other in enumerate(apart) if j != i)
        share = (1.0 - zero / lag) / others
        total = total + (lag * share if integrator else -share) * np.exp(-time / lag)
    return np.where(t >= delay, gain * total, 0.0)


def process_model(t: Array, y: Array, *, integrator: bool = False) -> ProcessModel:
    """The simplest process model of a step response y (N,) at times t (N,) in s: a structure with
    one more lag or a zero is taken only where it halves the error. Raises UserError for a response
    without a change."""
    from scipy.optimize import least_squares

    size = float(np.linalg.norm(y - y.mean()))
    if size <= 0 or len(t) < 4:
        raise UserError("the step response does not change: there is no process model")
    # Differences of a fit need numbers of the size of 1: time in samples, y over its size.
    every = float(np.diff(t).min())
    t, y = t / every, y / size
    span, rate = float(t[-1]), every if integrator else 1.0
    best: tuple[float, ProcessModel] | None = None
    for lags, zero in ((1, False), (2, False), (2, True), (3, False), (3, True)):
        here: tuple[float, ProcessModel] | None = None
        for share in (0.03, 0.1, 0.3):
            for dead in (0.0, 2.0):
                final = float(y[-1]) / (span if integrator else 1.0)
                start = [final, *(np.log(share * span / (k + 1.0)) for k in range(lags)), dead]
                start += [0.0] * zero

                def model(z: Array, lags: int = lags, zero: bool = zero) -> ProcessModel:
                    times = tuple(float(one) for one in np.exp(np.clip(z[1 : lags + 1], -30, 30)))
                    lead = float(z[lags + 2]) if zero else 0.0
                    late = float(abs(z[lags + 1]))
                    late = 0.0 if late < 1e-3 else late
                    ordered = tuple(sorted(times, reverse=True))
                    return ProcessModel(float(z[0]), ordered, lead, late, integrator, 0.0)

                def error(z: Array, of: Any = model) -> Array:
                    return of(z).step(t) - y

                found = least_squares(error, start, x_scale="jac", max_nfev=300)
                left = float(np.linalg.norm(found.fun))
                if np.isfinite(left) and (here is None or left < here[0]):
                    here = left, replace(model(found.x), fit=100.0 * (1.0 - left))
        if here is not None and (best is None or here[0] < 0.5 * best[0]):
            best = here
        if best is not None and best[0] < _CLOSE:
            break
    assert best is not None
    one = best[1]
    return replace(
        one, gain=one.gain * size / rate, lags=tuple(every * lag for lag in one.lags),
        zero=every * one.zero, delay=every * one.delay,
    )  # fmt: skip


def settling_samples(model: LinearModel, most: int = 5_000) -> int:
    """Samples in which the slowest stable mode decays to 1 %, for pictures and process models."""
    sizes = np.abs(model.poles)
    slow = sizes[(sizes > 0) & (sizes < 1.0 - _INTEGRATOR)].max(initial=0.0)
    wanted = 1.3 * math.log(0.01) / math.log(slow) if 0 < slow < 1 else 20.0
    return int(min(max(wanted, 20.0), most)) + int(model.delay.max(initial=0))


def fold_band(value: Array, folds: Sequence[Array]) -> tuple[Array, Array]:
    """90 % band of a value by those of fold models: jackknife error times Student's t, whose
    degrees of freedom are few; all fold models lie inside."""
    from scipy.special import stdtrit

    apart = np.sum([(one - value) ** 2 for one in folds], axis=0)
    rest = len(folds) - 1
    wide = float(stdtrit(rest, 0.95)) * np.sqrt(rest / len(folds) * apart)
    every = np.stack([value - wide, value + wide, *folds])
    return every.min(axis=0), every.max(axis=0)


def discretize(a: Array, b: Array, time: float) -> tuple[Array, Array]:
    """Zero-order hold of x' = A x + B u over a time: exp(A t) (n, n) and the effect of held inputs
    (n, nu)."""
    from scipy.linalg import expm

    n, nu = b.shape
    both = np.zeros((n + nu, n + nu))
    both[:n, :n], both[:n, n:] = a, b
    moved = np.asarray(expm(time * both), np.float64)
    return moved[:n, :n], moved[:n, n:]


def largest_gain(model: LinearModel) -> float:
    """Largest singular value of the frequency response; infinite with an integrator."""
    if model.is_integrating:
        return math.inf
    peaks = [f for _, f, z, _ in model.modes() if np.isfinite(f) and abs(z) < 1]
    peaks = [f for f in peaks if f < 0.5 / model.sampling_time]
    at = np.concatenate([[0.0], corner_frequencies(model), peaks])
    return float(np.linalg.svd(model.response(at), compute_uv=False).max(initial=0.0))


def corner_frequencies(model: LinearModel, points: int = 300) -> Array:
    """Frequencies in Hz for a Bode plot: from a hundredth of the slowest mode to Nyquist's."""
    nyquist = 0.5 / model.sampling_time
    known = [f for _, f, _, _ in model.modes() if np.isfinite(f) and f > 1e-9 * nyquist]
    low = min([*known, 0.1 * nyquist]) / 100.0
    return np.geomspace(max(low, 1e-6 * nyquist), 0.999 * nyquist, points)
