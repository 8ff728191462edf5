"""The two tanks by hand: a Runge-Kutta loop compiled by Numba and SciPy's least_squares, started
from points drawn in the ranges of the parameters. Prints the held-out error after each start."""

import sys

import numba
import numpy as np
from scipy.optimize import least_squares

SUBSTEPS = 2
LOW, HIGH = np.log(1e-3), np.log(1.0)


@numba.njit
def rates(k, x1, x2, u):
    """Both levels' rates of change."""
    out = np.sqrt(max(x1, 0.0))
    return -k[0] * out + k[3] * u, k[1] * out - k[2] * np.sqrt(max(x2, 0.0))


@numba.njit
def levels(theta, u, step):
    """Lower level (T,); theta: logs of four parameters, two initial levels."""
    k = np.exp(theta[:4])
    x1, x2 = theta[4], theta[5]
    y = np.empty(len(u))
    for i in range(len(u)):
        y[i] = x2
        for _ in range(SUBSTEPS):
            a1, a2 = rates(k, x1, x2, u[i])
            b1, b2 = rates(k, x1 + 0.5 * step * a1, x2 + 0.5 * step * a2, u[i])
            c1, c2 = rates(k, x1 + 0.5 * step * b1, x2 + 0.5 * step * b2, u[i])
            d1, d2 = rates(k, x1 + step * c1, x2 + step * c2, u[i])
            x1 = max(x1 + step / 6 * (a1 + 2 * b1 + 2 * c1 + d1), 0.0)
            x2 = min(max(x2 + step / 6 * (a2 + 2 * b2 + 2 * c2 + d2), 0.0), 10.0)
    return y


def main():
    """Fit from start after start until the target is reached."""
    d = np.load(sys.argv[1])
    step = float(d["sampling_time"]) / SUBSTEPS
    u, y = d["train_u"][:, 0], d["train_y"][:, 0]
    past_u, past_y = d["past_u"][:, 0], d["past_y"][:, 0]
    whole = np.concatenate([past_u, d["u"][:, 0]])
    random = np.random.default_rng(int(d["seed"]))
    for _ in range(20):
        theta = np.concatenate([random.uniform(LOW, HIGH, 4), [y[0], y[0]]])
        fit = least_squares(lambda t: levels(t, u, step) - y, theta, x_scale="jac")
        theta = fit.x

        def start(x, theta=theta):
            return levels(np.concatenate([theta[:4], x]), past_u, step) - past_y

        found = least_squares(start, [past_y[0], past_y[0]]).x
        y_hat = levels(np.concatenate([theta[:4], found]), whole, step)[len(past_u) :]
        error = float(np.sqrt(np.mean((y_hat - d["y"][:, 0]) ** 2)) / d["scale"][0])
        print("error", error if np.isfinite(error) else 1e9, flush=True)
        if error <= d["target"]:
            return


main()
