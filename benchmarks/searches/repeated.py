"""Value of a ranking by V, on eleven repeated searches that were published with their test errors.

Each search is one trial: its V, and the error of its winner on the sealed test [V]. The same
statistics as `asia validate --repeat` uses for candidates: how low the best of as many equal
ones comes by luck alone, and what the best by V is worth on the test.

    ASIA_DATA_DIR=/path/to/data python benchmarks/searches/repeated.py
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import numpy as np
from scipy import stats

from asia.judge.scoring.repeated_fits import expected_lowest

PAIRS = re.compile(r"\((0\.\d+), (0\.\d+)\)")
MARK = "11 repeated searches on tanks (V, test)"
SHUFFLES = 100_000


def read(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """V and test error of each search."""
    lines = (folder / "README.md").read_text().splitlines()
    line = next(line for line in lines if MARK in line)
    pairs = [(float(a), float(b)) for a, b in PAIRS.findall(line)]
    value, test = np.array(pairs).T
    return value, test


def correlation(value: np.ndarray, test: np.ndarray, seed: int) -> tuple[float, float, float]:
    """Spearman's, and its 95 % interval by the bias-corrected bootstrap over searches."""
    drawn = stats.bootstrap(
        (value, test), lambda a, b: stats.spearmanr(a, b).statistic, paired=True,
        vectorized=False, n_resamples=5000, rng=seed,
    )  # fmt: skip
    interval = drawn.confidence_interval
    return float(stats.spearmanr(value, test).statistic), float(interval.low), float(interval.high)


def by_luck(value: np.ndarray, test: np.ndarray, seed: int) -> float:
    """How often a shuffled order correlates as much or more, one-sided."""
    random = np.random.default_rng(seed)
    ranks, other = stats.rankdata(value), stats.rankdata(test)
    found = float(np.corrcoef(ranks, other)[0, 1])
    shuffled = np.array([random.permutation(other) for _ in range(SHUFFLES)])
    centred = (shuffled - other.mean()) @ (ranks - ranks.mean())
    return float(np.mean(centred >= found * len(ranks) * ranks.std() * other.std() - 1e-9))


def main() -> None:
    folder = os.environ.get("ASIA_DATA_DIR")
    if folder is None:
        sys.exit("ASIA_DATA_DIR is not set: name the folder with the published searches")
    value, test = read(Path(folder))
    n, mean, spread = len(value), value.mean(), value.std(ddof=1)
    lowest = mean + expected_lowest(n) * spread
    rho, low, high = correlation(value, test, 0)
    pairs = [(i, j) for i in range(n) for j in range(n) if value[i] < value[j]]
    agree = np.mean([test[i] < test[j] for i, j in pairs])
    best = int(np.argmin(value))
    order = np.argsort(value)
    ratio = np.log(test / value)
    half = stats.t.ppf(0.95, n - 1) * ratio.std(ddof=1) * np.sqrt(1 + 1 / n)
    slope = stats.linregress(value, test)
    print(f"searches {n}: V {mean:.4f}, s.d. {spread:.4f}, {value.min():.4f} to {value.max():.4f}")
    print(f"lowest V of {n} equal searches by luck alone {lowest:.4f}, found {value.min():.4f}")
    print(f"rank correlation of V and test {rho:.2f} ({low:.2f} to {high:.2f}), "
          f"by luck with probability {by_luck(value, test, 0):.2f}")  # fmt: skip
    print(f"of two searches the one with lower V has the lower test error: {agree:.0%} of "
          f"{len(pairs)} pairs")  # fmt: skip
    print(f"test error by one unit of V {slope.slope:.2f}, standard error {slope.stderr:.2f}")
    place = int((test < test[best]).sum()) + 1
    print(f"best by V: test {test[best]:.4f}, place {place} of {n}; "
          f"mean of all {test.mean():.4f}, s.d. {test.std(ddof=1):.4f}")  # fmt: skip
    thirds = test[order[:4]].mean(), test[order[-4:]].mean()
    print(f"test error of the four lowest V {thirds[0]:.4f}, of the four highest {thirds[1]:.4f}")
    centre = ratio.mean()
    for name, v in (("lowest V", value.min()), ("V freed of luck", mean)):
        low_t, mid, high_t = (v * np.exp(centre + side * half) for side in (-1, 0, 1))
        print(f"expected test error from the {name} {v:.4f}: {mid:.3f}, "
              f"90 % {low_t:.3f} to {high_t:.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
