"""Do the built-in benchmarks read the published data in the official division? One linear ARX model
by least squares, with all samples of the initialisation window as lags, against the ARX rows that
M. D. Champneys et al. (https://arxiv.org/abs/2405.10779) published.

This opens the test set: it is a baseline of the literature, not a search. Nothing is chosen by it.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.signal import lfilter, lfiltic

from asia.data import Trajectory
from asia.errors import UserError
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.report.published import leaderboard

NAMES = ("wiener_hammerstein", "silverbox", "emps")
PUBLISHED = "ARX"


def regressors(record: Trajectory, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows y[k-1..k-lags], u[k..k-lags], 1 and the outputs y[k], from k = lags on."""
    u, y = record.u[:, 0], record.y[:, 0]
    rows = np.lib.stride_tricks.sliding_window_view
    past = rows(y[:-1], lags)[:, ::-1]
    inputs = rows(u, lags + 1)[:, ::-1]
    return np.hstack([past, inputs, np.ones((len(inputs), 1))]), y[lags:]


def fit(records: tuple[Trajectory, ...], lags: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Coefficients of the past outputs and of the inputs, and the constant."""
    found = [regressors(record, lags) for record in records]
    x, y = (np.concatenate(part) for part in zip(*found, strict=True))
    theta = np.linalg.lstsq(x, y, rcond=None)[0]
    return theta[:lags], theta[lags:-1], float(theta[-1])


def simulate(a: np.ndarray, b: np.ndarray, constant: float, record: Trajectory) -> np.ndarray:
    """The free run after the first `len(a)` samples."""
    lags, u, y = len(a), record.u[:, 0], record.y[:, 0]
    forced = np.convolve(u, b)[lags : len(u)] + constant
    denominator = np.concatenate([[1.0], -a])
    start = lfiltic([1.0], denominator, y[lags - 1 :: -1])
    return lfilter([1.0], denominator, forced, zi=start)[0]


def errors(problem: Problem) -> list[tuple[str, float]]:
    """RMSE of each test record in the official unit."""
    rule = problem.protocol
    model = fit(problem.train, rule.past)
    factor = rule.test.unit_factor or 1.0
    found: list[tuple[str, float]] = []
    for record in problem.data.records("test", problem.channels).trajectories:
        missed = record.y[rule.past :, 0] - simulate(*model, record)
        found.append((record.name, factor * float(np.sqrt(np.mean(missed**2)))))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", default=",".join(NAMES))
    for name in parser.parse_args().problems.split(","):
        try:
            problem = load_problem(name)
        except UserError as error:
            print(f"{name}: left out, {str(error)[:90]}...")
            continue
        (row,) = [e for e in leaderboard(name) if e.method == PUBLISHED]
        for (record, ours), published in zip(errors(problem), row.figures, strict=True):
            assert published is not None
            unit = problem.protocol.test.unit
            change = 100 * (ours / published - 1)
            print(f"{name} {record}: {ours:.3g} {unit}, published {published:g}, {change:+.1f} %")


if __name__ == "__main__":
    main()
