"""Linear models whose state is the past window, and the choice of their horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._arrays import AnyArray
from asia.models._least_squares import SEQUENTIAL, LevenbergMarquardt, NormalEquations, minimise
from asia.models._linear.fit import Refinement
from asia.models._linear.system import LinearSystem
from asia.models._numerics.encoder import Encoder, affine
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    SegmentBatch,
    contiguous_splits,
    cut_windows,
    mean_square,
    past_length,
    regress_outputs,
)

# Linear model with the past window as state, fitted over the windows' whole horizon.
#
# y[k] = theta' [w[k], u[k], 1], where w[k] holds the last outputs and inputs and the model's own
# outputs replace measured ones as they appear. Started by one-step least squares, then refined on
# the simulation error over the horizon; no constraint makes it stable beyond that. Source: Ljung,
# System Identification, 2nd ed., sections 4.2 and 7.2 (output-error predictor).

# Beyond this size one-step least squares is kept: the refinement's cost grows with the square.
MOST_PARAMETERS = 400


@dataclass(frozen=True)
class WindowLags:
    """Numbers of past samples kept in the state, of those that the protocol shows."""

    n_past_u: int  # Inputs shown
    n_past_y: int  # Outputs shown
    u: int  # Inputs kept, at most as many
    y: int  # Outputs kept, at most as many
    nu: int  # Input channels
    ny: int  # Output channels

    @property
    def order(self) -> int:
        """Length of the state."""
        return self.u * self.nu + self.y * self.ny

    @property
    def parameters(self) -> int:
        """Length of theta."""
        return (self.order + self.nu + 1) * self.ny

    def state(self, features: Array) -> Array:
        """Convert past windows (W, d) in the layout of `window` to states (W, order)."""
        return features @ self.selection()

    def selection(self) -> Array:
        """Matrix (d, order) of zeros and ones that selects the state from a window."""
        split, end = self.n_past_u * self.nu, self.n_past_u * self.nu + self.n_past_y * self.ny
        rows = np.r_[split - self.u * self.nu : split, end - self.y * self.ny : end]
        return np.eye(end)[:, rows]

    def shift(self) -> tuple[Array, Array, Array]:
        """Matrices of w <- w S + u U + y Y for row vectors: S (order, order), U (nu, order), Y (ny,
        order)."""
        split, size = self.u * self.nu, self.order
        s, from_u, from_y = (np.zeros((n, size)) for n in (size, self.nu, self.ny))
        for first, last, step in ((0, split, self.nu), (split, size, self.ny)):
            s[np.arange(first + step, last), np.arange(first, last - step)] = 1.0
        if self.u:
            from_u[:, split - self.nu : split] = np.eye(self.nu)
        if self.y:
            from_y[:, size - self.ny :] = np.eye(self.ny)
        return s, from_u, from_y


@dataclass(frozen=True)
class WindowPredictor:
    """Coefficients of a windowed linear model, for z-scored signals."""

    lags: WindowLags  # Lags in the state
    theta: Array  # (order + nu + 1, ny)
    ridge: float = 0.0  # Ridge of the fit, against the mean squared error

    def simulate(self, windows: SegmentBatch) -> Array:
        """Simulate windows: outputs (W, H, ny)."""
        s, from_u, from_y = self.lags.shift()
        x, outputs = self.lags.state(windows.window), np.empty_like(windows.y)
        for k in range(windows.u.shape[1]):
            u = windows.u[:, k]
            outputs[:, k] = _regressors(x, u) @ self.theta
            x = x @ s + u @ from_u + outputs[:, k] @ from_y
        return outputs

    def error(self, windows: SegmentBatch) -> float:
        """Mean squared simulation error; infinite where it diverges."""
        with np.errstate(all="ignore"):
            error = mean_square(self.simulate(windows) - windows.y, windows.weight)
        return error if np.isfinite(error) else float("inf")

    def system(self) -> tuple[LinearSystem, Encoder]:
        """State-space form, the constant 1 as its last state, and the map from past windows."""
        n, lags = self.lags.order, self.lags
        s, from_u, from_y = lags.shift()
        by_x, by_u, constant = self.theta[:n], self.theta[n:-1], self.theta[-1:]
        a = np.zeros((n + 1, n + 1))
        a[:n, :n] = s + by_x @ from_y
        a[n, :n] = (constant @ from_y)[0]
        a[n, n] = 1.0
        b = np.pad(from_u + by_u @ from_y, ((0, 0), (0, 1)))
        c = np.concatenate([by_x, constant])
        selection = np.pad(lags.selection(), ((0, 0), (0, 1)))
        encoder = affine(selection, np.eye(n + 1)[n])
        return LinearSystem(a.T, b.T, c.T, by_u.T, np.zeros(lags.ny)), encoder


def one_step(windows: SegmentBatch, lags: WindowLags, ridge: float) -> WindowPredictor:
    """Least squares on all one-step predictions inside the windows; `ridge` weighs, against the
    mean square of the signals, the distance from `held`."""
    s, from_u, from_y = lags.shift()
    x, regressors = lags.state(windows.window), list[Array]()
    for k in range(windows.u.shape[1]):
        u, y = windows.u[:, k], windows.y[:, k]
        regressors.append(_regressors(x, u))
        x = x @ s + u @ from_u + y @ from_y
    phi = np.concatenate(regressors)
    target = np.swapaxes(windows.y, 0, 1).reshape(len(phi), -1)
    weight = np.swapaxes(windows.weight, 0, 1).reshape(target.shape)
    rest = held(lags)

    def solve(z: Array, apart: Array) -> AnyArray:
        gram = z.T @ z + ridge * len(z) * np.eye(z.shape[1])
        return np.linalg.solve(gram, z.T @ apart)

    return WindowPredictor(lags, rest + regress_outputs(phi, target - phi @ rest, weight, solve))


def held(lags: WindowLags) -> Array:
    """Coefficients theta of the model that holds the last output: the centre of the ridge."""
    theta = np.zeros((lags.order + lags.nu + 1, lags.ny))
    if lags.y:
        theta[lags.order - lags.ny : lags.order] = np.eye(lags.ny)
    return theta


def refined(
    start: WindowPredictor, windows: SegmentBatch, ridge: float, iterations: int, tolerance: float
) -> WindowPredictor:
    """Refine by Levenberg-Marquardt on the mean squared simulation error over the windows' horizon,
    plus `ridge` times the squared distance from `held`."""
    rest, samples = held(start.lags), max(float(windows.weight.sum()), 1.0)

    def objective(model: WindowPredictor) -> float:
        return model.error(windows) + ridge * float(((model.theta - rest) ** 2).sum())

    def model(theta: Array) -> WindowPredictor:
        return WindowPredictor(start.lags, theta.reshape(rest.shape), ridge)

    def cost(points: Array) -> Array:
        return np.array([[objective(model(points[0, 0]))]])

    def linearise(theta: Array) -> NormalEquations:
        current = model(theta[0])
        gram, gradient = _normal_equations(current, windows)
        gram = gram / samples + ridge * np.eye(len(gram))
        gradient = ridge * (current.theta - rest).ravel() - gradient / samples
        return NormalEquations(np.array([objective(current)]), gram[None], gradient[None])

    if not np.isfinite(objective(start)):
        return start
    method = LevenbergMarquardt(iterations, damping=1e-3, tolerance=tolerance)
    found = minimise(cost, linearise, start.theta.reshape(1, -1), method, SEQUENTIAL)
    return model(found.theta[0])


def window_error(system: LinearSystem, encoder: Encoder, windows: SegmentBatch) -> float:
    """Mean squared error of simulations that begin with the encoder's states."""
    y = system.simulate(encoder(windows.window), windows.u)[1]
    return mean_square(y - windows.y, windows.weight)


def _regressors(x: Array, u: Array) -> Array:
    return np.concatenate([x, u, np.ones((len(x), 1))], axis=1)


def _normal_equations(model: WindowPredictor, windows: SegmentBatch) -> tuple[Array, Array]:
    """Compute J' J (P, P) and J' e (P,) without storing a Jacobian."""
    # The cost of each way is that of its largest products: by lags samples^2, by steps samples
    # ny^3.
    if windows.weight.all() and windows.u.shape[1] < 2 * model.lags.ny**3:
        return normal_by_lags(model, windows)
    return normal_by_steps(model, windows)


def normal_by_lags(model: WindowPredictor, windows: SegmentBatch) -> tuple[Array, Array]:
    """Normal equations as sums over lags.

    All windows share the responses H_r of the outputs to a change r samples before, so that J' J
    is a sum over lags of products of those with correlations of the regressors.
    """
    lags, ny = model.lags, model.lags.ny
    s, from_u, from_y = lags.shift()
    samples, size = windows.u.shape[1], model.theta.size
    x, phi, errors = lags.state(windows.window), list[Array](), list[Array]()
    change, responses = from_y.T, [np.eye(ny)]
    for k in range(samples):
        u = windows.u[:, k]
        phi.append(_regressors(x, u))
        y = phi[-1] @ model.theta
        errors.append(windows.y[:, k] - y)
        x = x @ s + u @ from_u + y @ from_y
        responses.append(model.theta[: lags.order].T @ change)
        change = s.T @ change + from_y.T @ responses[-1]
    z, e, h = np.stack(phi), np.stack(errors), np.stack(responses[:samples])
    gram = np.zeros((ny, ny, z.shape[2], z.shape[2]))
    for lag in range(samples):
        left = samples - lag
        both = np.cumsum(h[lag:].transpose(0, 2, 1) @ h[:left], axis=0)[::-1]
        regressors = z[:left].transpose(0, 2, 1) @ z[lag:]
        part = both.reshape(left, -1).T @ regressors.reshape(left, -1)
        part = part.reshape(gram.shape)
        gram += part + part.transpose(1, 0, 3, 2) if lag else part
    later = [np.tensordot(e[k:], h[: samples - k], ([0, 2], [0, 1])) for k in range(samples)]
    gradient = np.tensordot(z, np.stack(later), ([0, 1], [0, 1]))
    return gram.transpose(2, 0, 3, 1).reshape(size, size), gradient.ravel()


def normal_by_steps(model: WindowPredictor, windows: SegmentBatch) -> tuple[Array, Array]:
    """Normal equations as sums over the sensitivities of one step after the other."""
    lags, ny = model.lags, model.lags.ny
    s, from_u, from_y = lags.shift()
    by_x = model.theta[: lags.order]
    x = lags.state(windows.window)
    size = model.theta.size
    sensitivity = np.zeros((len(windows.u), lags.order, size))
    gram, gradient = np.zeros((size, size)), np.zeros(size)
    for k in range(windows.u.shape[1]):
        u = windows.u[:, k]
        phi = _regressors(x, u)
        moved = np.matmul(by_x.T, sensitivity)
        for j in range(ny):
            moved[:, j, j::ny] += phi
        y = phi @ model.theta
        error = windows.weight[:, k] * (windows.y[:, k] - y)
        rows = windows.weight[:, k].reshape(-1, 1) * moved.reshape(-1, size)
        gram += rows.T @ rows
        gradient += rows.T @ error.ravel()
        x = x @ s + u @ from_u + y @ from_y
        sensitivity = np.matmul(s.T, sensitivity) + np.matmul(from_y.T, moved)
    return gram, gradient


# Choice among windowed linear models: number of past samples in the state, and ridge.

# Ridges against the mean squared error in z-scores, from strong to weak.
_RIDGES = (1.0, 1e-1, 1e-2, 1e-4)
_QUICK_ITERATIONS = 4
# Limits on the work of a refinement: samples times squared parameters.
_SELECTION_WORK, _FINAL_WORK = 4e9, 2e10
_FEWEST, MOST_WINDOWS = 24, 2000


@dataclass(frozen=True)
class WindowedChoice:
    """Lags and ridge, with their errors."""

    lags: WindowLags  # Past samples kept in the state
    ridge: float  # Ridge against the mean squared error in z-scores
    errors: tuple[float, ...]  # Mean squared error on the windows of each segment left out

    @property
    def error(self) -> float:
        """Mean error over all segments."""
        return float(np.mean(self.errors))


def choose(records: ScaledData, context: Context, refinement: Refinement) -> WindowedChoice | None:
    """Choose lags and ridge by the error on segments left out.

    For each number of lags the choice is the strongest ridge within one standard error, over the
    segments, of the best; the result is the best of these, None where the past window is empty.
    """
    splits, choices = held_out(records, context), list[WindowedChoice]()
    for lags in _candidates(records, context):
        count = _count(lags, context, _SELECTION_WORK)
        paths: list[list[float]] = []
        for kept, left in splits:
            # Mean squared errors along the ridges, each fit started from the one before.
            cut = cut_windows(kept, context, count)
            unseen = cut_windows(left, context, MOST_WINDOWS)
            current, path = one_step(cut, lags, _one_step_ridge(_RIDGES[0])), list[float]()
            for ridge in _RIDGES:
                current = _refined(current, cut, ridge, _QUICK_ITERATIONS, refinement)
                path.append(min(current.error(unseen), 1e12))
            paths.append(path)
        errors = np.array(paths)
        means = errors.mean(axis=0)
        best = int(np.argmin(means))
        apart = errors - errors[:, best : best + 1]
        limit = 0.0 * means
        if len(splits) > 1:
            limit = apart.std(axis=0, ddof=1) / np.sqrt(len(splits))
        chosen = int(np.argmax(means - means[best] <= limit))
        choices.append(WindowedChoice(lags, _RIDGES[chosen], tuple(errors[:, chosen].tolist())))
    return min(choices, key=lambda c: c.error) if choices else None


def held_out(
    records: ScaledData, context: Context
) -> list[tuple[list[ScaledTrajectory], list[ScaledTrajectory]]]:
    """Three splits (kept, left out) with other segments left out each time: with enough records
    neighbouring ones, since successive records are often of one kind."""
    if len(records) >= 3:
        groups = np.array_split(np.arange(len(records)), 3)
        return [
            ([r for i, r in enumerate(records) if i not in g], [records[i] for i in g])
            for g in groups
        ]
    return contiguous_splits(records, 3, past_length(context) + 2 * (context.horizon or 1))


def fit_choice(
    records: ScaledData, context: Context, choice: WindowedChoice, refinement: Refinement
) -> WindowPredictor:
    """Refine the chosen lags and ridge on windows from all records."""
    windows = cut_windows(records, context, _count(choice.lags, context, _FINAL_WORK))
    start = one_step(windows, choice.lags, _one_step_ridge(choice.ridge))
    return _refined(start, windows, choice.ridge, refinement.iterations, refinement)


def _candidates(records: ScaledData, context: Context) -> list[WindowLags]:
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    past_u, past_y = context.n_past_u, context.n_past_y
    found: list[WindowLags] = []
    for count in sorted({1, 2, 4, past_length(context)}):
        lags = WindowLags(past_u, past_y, min(count, past_u), min(count, past_y), nu, ny)
        fits = not found or lags.parameters <= MOST_PARAMETERS
        if lags.order and fits and lags not in found:
            found.append(lags)
    return found


def _refined(
    start: WindowPredictor,
    windows: SegmentBatch,
    ridge: float,
    iterations: int,
    refinement: Refinement,
) -> WindowPredictor:
    if start.lags.parameters > MOST_PARAMETERS:
        return one_step(windows, start.lags, _one_step_ridge(ridge))
    iterations = min(iterations, refinement.iterations)
    return refined(start, windows, ridge, iterations, max(refinement.tolerance, 1e-4))


def _one_step_ridge(ridge: float) -> float:
    # One-step errors are smaller than those over a horizon, and so is their ridge.
    return max(1e-4 * ridge, 1e-9)


def _count(lags: WindowLags, context: Context, work: float) -> int:
    each = (context.horizon or 1) * lags.ny * lags.parameters**2
    return int(np.clip(work / each, _FEWEST, MOST_WINDOWS))
