"""Do 90 % bands hold 90 % of records that no fit saw: measured systems and generated plants?

One cheap candidate a system, fitted to each fold in this process, without a search. Folds,
errors, region and bands are those of asia.simulate. Two figures a system: the share of each fold
that bands hold which were made without that fold, and the share of the test record. A band that is
withdrawn counts as withdrawn, not as covered.

    python benchmarks/validation/band_coverage.py --zoo DATA/zoo
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from asia.data import Array, Signal, Trajectory
from asia.data.segment import Segment
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.references import LINEAR
from asia.judge.scoring.bands import HeldOutErrors, region_of
from asia.problem.folds import make_folds, whole
from asia.problem.load import load_problem, read_records
from asia.problem.problem import Problem
from asia.search.simulation import BAND_LEVEL, BandBasis

SYSTEMS = (
    "hairdryer", "heating", "dryer2", "thermic_wall", "ph", "cd_arm", "winding", "evaporator",
    "cstr", "steamgen", "exchanger",
)  # fmt: skip
ARX = """# A difference equation by least squares, its order by the simulation error.
import numpy as np


class M:
    def simulate(self, past_u, past_y, u):
        n = self.n
        U = np.concatenate([past_u[0], u[0]]) - self.mu
        Y = list((past_y[0] - self.my))
        off = len(past_u[0])
        offy = len(Y)
        out = []
        for k in range(len(u[0])):
            f = []
            for i in range(1, n + 1):
                f.append(Y[-i] if i <= len(Y) else np.zeros_like(self.my))
            for i in range(0, n + 1):
                f.append(U[off + k - i] if off + k - i >= 0 else np.zeros_like(self.mu))
            y = np.clip(np.concatenate(f) @ self.th, -self.lim, self.lim)
            Y.append(y)
            out.append(y + self.my)
        return np.array(out)[None]


def fit(trajectories, context):
    best = None
    for n in (1, 2, 3, 5):
        X = []
        T = []
        mu = np.concatenate([t.u for t in trajectories]).mean(0)
        my = np.concatenate([t.y for t in trajectories]).mean(0)
        for t in trajectories:
            u = t.u - mu
            y = t.y - my
            for k in range(n, len(y)):
                X.append(
                    np.concatenate(
                        [
                            *(y[k - i] for i in range(1, n + 1)),
                            *(u[k - i] for i in range(0, n + 1)),
                        ]
                    )
                )
                T.append(y[k])
        X = np.array(X)
        T = np.array(T)
        m = M()
        m.n = n
        m.mu = mu
        m.my = my
        m.lim = 3 * np.abs(T).max(0)
        m.th = np.linalg.lstsq(X.T @ X + 1e-4 * np.diag(np.diag(X.T @ X)), X.T @ T, rcond=None)[
            0
        ]
        e = 0
        for t in trajectories:
            p = 10
            s = m.simulate(t.u[None, :p], t.y[None, :p], t.u[None, p : p + 1500])[0]
            e += ((s - t.y[p : p + 1500]) ** 2 / T.var(0)).sum()
        if best is None or e < best[0]:
            best = (e, m)
    return best[1]
"""
CANDIDATES = {"arx": ARX, "linear": LINEAR}


@dataclass(frozen=True)
class Fitted:
    """Fold models of one candidate on one system, with their answers."""

    basis: BandBasis
    test: tuple[Segment, ...]
    answers: tuple[Array, ...]
    """(K, H, ny) for each block of the test."""


def fitted(problem: Problem, test: Sequence[Trajectory], source: str) -> Fitted:
    """Fit a candidate to each fold."""
    space: dict[str, Any] = {}
    exec(source, space)
    fit: Callable[..., Any] = space["fit"]
    folds, rule = make_folds(problem.train, problem.protocol), problem.protocol
    blocks = whole(test, rule)
    errors: list[HeldOutErrors] = []
    simulated: list[tuple[Array, ...]] = []
    answers: list[list[Array]] = [[] for _ in blocks]
    for fold in folds:
        model = fit(fold.train, search_context(problem, fold.index))
        own = [answer(model, block) for block in fold.held_out]
        simulated.append(tuple(own))
        pairs = zip(fold.held_out, own, strict=True)
        errors.append(HeldOutErrors(tuple(b.y - y for b, y in pairs)))
        for place, block in enumerate(blocks):
            answers[place].append(answer(model, block))
    region = region_of([(r.u, r.y) for r in problem.train])
    basis = BandBasis(tuple(errors), tuple(simulated), region, rule.horizon is not None)
    return Fitted(basis, blocks, tuple(map(np.stack, answers)))


def answer(model: Any, block: Segment) -> Array:
    """Simulation (H, ny) of one block."""
    return model.simulate(block.past_u[None], block.past_y[None], block.u[None])[0]


def on_test(found: Fitted) -> tuple[Array, Array]:
    """Share of the test samples that the bands hold, and of those outside the region; (ny,)."""
    held = known = outside = 0
    for block, each in zip(found.test, found.answers, strict=True):
        bands, out = found.basis.around(block, each, each.mean(axis=0), BAND_LEVEL)
        inside = (bands.lower <= block.y) & (block.y <= bands.upper)
        held, known = held + inside.sum(axis=0), known + (~np.isnan(block.y)).sum(axis=0)
        outside += out.sum()
    return held / known, outside / known


def plant(seed: int, folder: Path) -> tuple[Problem, list[Trajectory]]:
    """A random plant of one to three lags with a mild bend, noise and a random input."""
    rng = np.random.default_rng([59, seed])
    poles = np.exp(-1.0 / rng.uniform(3.0, 40.0, int(rng.integers(1, 4))))
    bend, noise = rng.uniform(0.0, 0.4), rng.uniform(0.02, 0.2)
    records: list[Trajectory] = []
    for name, samples in (("train", 1500), ("test", 800)):
        hold = int(rng.integers(5, 40))
        u = np.repeat(rng.uniform(-1.0, 1.0, -(-samples // hold)), hold)[:samples]
        y = u
        for pole in poles:
            x = np.zeros(samples)
            for k in range(1, samples):
                x[k] = pole * x[k - 1] + (1.0 - pole) * y[k - 1]
            y = x
        y = y + bend * y**2
        e = rng.standard_normal(samples)
        for k in range(1, samples):
            e[k] += 0.8 * e[k - 1]
        y = y + noise * y.std() * e * 0.6
        records.append(Trajectory(u[:, None], y[:, None], 1.0, name))
    problem = Problem.from_arrays(
        records[0].u,
        records[0].y,
        sampling_time=1.0,
        directory=folder,
        inputs=[Signal("u")],
        outputs=[Signal("y")],
    )
    return problem, records[1:]


def main() -> None:
    """Print a row for each system and candidate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--zoo", type=Path)
    parser.add_argument("--systems", nargs="+", default=SYSTEMS)
    parser.add_argument("--plants", type=int, default=10)
    parser.add_argument("--candidates", nargs="+", choices=CANDIDATES, default=["arx"])
    options = parser.parse_args()
    cases: list[tuple[str, Problem, Sequence[Trajectory]]] = []
    if options.zoo is not None:
        for name in options.systems:
            problem = load_problem(options.zoo / name)
            cases.append((name, problem, read_records(problem, options.zoo / name / "test.csv")))
    with TemporaryDirectory() as folder:
        cases += [(f"plant {k}", *plant(k, Path(folder) / str(k))) for k in range(options.plants)]
    print("| output | candidate | wider | folds, left out | test | outside | withdrawn |")
    print("|---|---|---|---|---|---|---|")
    for name, problem, test in cases:
        for candidate in options.candidates:
            found = fitted(problem, test, CANDIDATES[candidate])
            for line in rows(name, candidate, found):
                print(line, flush=True)


def rows(name: str, candidate: str, found: Fitted) -> Iterator[str]:
    """A line of the table for each output."""
    (held, outside), check = on_test(found), found.basis.calibration
    for k, reason in enumerate(check.withdrawn):
        cells = [f"{name}, {k + 1}", candidate, f"{check.factor[k]:.2f}"]
        cells += [f"{100 * v:.0f} %" for v in (check.held[:, k].mean(), held[k], outside[k])]
        yield f"| {' | '.join([*cells, 'yes' if reason else 'no'])} |"


if __name__ == "__main__":
    main()
