"""Does the interval for the best candidate's test error hold the sealed one as often as it says?

Small synthetic searches without a sandbox: a second-order system, mostly with a bent input or
output and coloured noise, ARX models of four orders and three random-feature models of the input,
whose fits depend on the seed. Each is scored on two contiguous folds, the lowest V wins, and
its fold models are asked for a new record that no fit has seen.

    python benchmarks/searches/expected.py --searches 200
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from asia.data import Array
from asia.judge.scoring.outcome import score_fold
from asia.judge.scoring.repeated_fits import (
    RepeatedFits,
    block_values,
    expected_error,
    expected_of_ensemble,
)

PAST, FOLD, LEVEL = 12, 200, 0.9
Model = Callable[[Array, Array], Array]
"""(inputs, outputs up to the start) -> simulated outputs after the first PAST samples."""


def record(rng: np.random.Generator, samples: int, kind: tuple[float, ...]) -> tuple[Array, Array]:
    """Input and output of a resonant system with a gain that bends, and noise of 5 % of it."""
    frequency, damping, bend, colour = kind
    radius = np.exp(-damping)
    a = [1.0, -2 * radius * np.cos(frequency), radius**2]
    u = np.repeat(rng.uniform(-1, 1, samples // 4 + 40), 4)[: samples + 100]
    x = lfilter([0.0, sum(a)], a, np.tanh(bend * u) / bend)
    x = x + 0.3 * bend * x**2
    e = lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], rng.normal(size=len(u)))
    y = x + 0.05 * x.std() * e
    return u[100:], y[100:]


def arx(order: int) -> Callable[[Array, Array, int], Model]:
    def fit(u: Array, y: Array, seed: int) -> Model:
        lags = [y[order - i : -i] for i in range(1, order + 1)]
        lags += [u[order - i : len(u) - i] for i in range(order + 1)]
        w = np.linalg.lstsq(np.stack(lags, 1), y[order:], rcond=None)[0]

        def simulate(inputs: Array, past: Array) -> Array:
            out = list(past)
            for k in range(PAST, len(inputs)):
                rows = [out[k - i] for i in range(1, order + 1)]
                rows += [inputs[k - i] for i in range(order + 1)]
                out.append(float(np.clip(np.dot(rows, w), -1e6, 1e6)))
            return np.array(out[PAST:])

        return simulate

    return fit


def features(count: int) -> Callable[[Array, Array, int], Model]:
    def fit(u: Array, y: Array, seed: int) -> Model:
        rng = np.random.default_rng(seed)
        inner, bias = rng.normal(size=(PAST + 1, count)) / 2, rng.normal(size=count)

        def rows(inputs: Array) -> Array:
            windows = np.lib.stride_tricks.sliding_window_view(inputs, PAST + 1)
            return np.hstack([windows, np.tanh(windows @ inner + bias), np.ones((len(windows), 1))])

        x = rows(u)
        w = np.linalg.solve(x.T @ x + 0.1 * np.eye(x.shape[1]), x.T @ y[PAST:])
        return lambda inputs, past: rows(inputs) @ w

    return fit


CANDIDATES = (*(arx(n) for n in (1, 2, 3, 5)), *(features(n) for n in (10, 20, 40)))


def judged(
    fit: Callable[[Array, Array, int], Model], u: Array, y: Array, seed: int
) -> tuple[RepeatedFits, list[Model]]:
    """A candidate on two contiguous folds, from one seed."""
    values, blocks, models = [], [], []
    for k in (0, 1):
        held, train = (slice(0, FOLD), slice(FOLD, None)) if k == 0 else (
            slice(FOLD, None), slice(0, FOLD))  # fmt: skip
        model = fit(u[train], y[train], 10 * seed + k)
        y_hat = model(u[held], y[held][:PAST])[:, None]
        measured, scale = y[held][PAST:, None], np.array([y[train].std()])
        values.append(score_fold([measured], [y_hat], scale, "rmse").value)
        blocks.append(block_values([measured], [y_hat], scale, "rmse"))
        models.append(model)
    return RepeatedFits(np.array([values]), np.array([blocks])), models


def search(number: int, seed: int) -> tuple[float, ...]:
    """Whether the interval holds the sealed error of a fold model in the mean, whether that is
    below, whether it lies between the V of the folds; the first two for the ensemble with its own
    interval; whether that of the fold models holds it; the width of that over the estimate."""
    rng = np.random.default_rng((seed, number))
    kind = (rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.4), rng.uniform(0.1, 1.5),
            rng.choice([0.0, 0.7]))  # fmt: skip
    u, y = record(rng, 2 * FOLD, kind)
    tried = [judged(fit, u, y, 0) for fit in CANDIDATES]
    best = int(np.argmin([fits.value for fits, _ in tried]))
    found = expected_error(tried[best][0], np.stack([f.blocks[0] for f, _ in tried]), LEVEL, number)
    new_u, new_y = record(rng, FOLD, kind)
    scale = np.array([y.std()])

    def errors(inputs: Array, outputs: Array) -> tuple[list[float], float]:
        """Error of each fold model and of their mean."""
        answers = [model(inputs, outputs[:PAST]) for model in tried[best][1]]
        found = [
            score_fold([outputs[PAST:, None]], [y_hat[:, None]], scale, "rmse").value
            for y_hat in (*answers, np.mean(answers, axis=0))
        ]
        return found[:-1], found[-1]

    each, ensemble = errors(new_u, new_y)
    error = float(np.mean(each))
    mean = expected_of_ensemble(found, *errors(u, y))
    own = tried[best][0].values[0]
    plain = own.min() <= error <= own.max()
    width = (found.high - found.low) / found.value
    return (found.low <= error <= found.high, error < found.low, bool(plain),
            mean.low <= ensemble <= mean.high, ensemble < mean.low,
            found.low <= ensemble <= found.high, width)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--searches", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    rows = np.array([search(n, wanted.seed) for n in range(wanted.searches)])
    held, below, plain, ensemble, under, other = 100 * rows[:, :6].mean(axis=0)
    print(f"{wanted.searches} searches of {len(CANDIDATES)} candidates, seed {wanted.seed}; "
          f"width {np.median(rows[:, 6]):.2f} of the estimate in the median")  # fmt: skip
    print(f"the {LEVEL:.0%} interval holds the sealed error of a fold model in {held:.1f} %; "
          f"below it {below:.1f} %, above it {100 - held - below:.1f} %")  # fmt: skip
    print(
        f"its own that of the ensemble in {ensemble:.1f} %; below it {under:.1f} %, "
        f"above it {100 - ensemble - under:.1f} %; that of a fold model {other:.1f} %"
    )
    print(f"between the V of the two folds: {plain:.1f} %")


if __name__ == "__main__":
    main()
