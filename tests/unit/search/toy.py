"""A small problem and NumPy candidates, so that the whole search runs in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asia.agents import AgentView, Proposal
from asia.problem.load import load_problem
from asia.search.run import prepare, search

ARX = """
import numpy as np


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        n = {order}
        b, h, nu = u.shape
        y = np.concatenate([past_y, np.zeros((b, h, past_y.shape[2]))], axis=1)
        x = np.concatenate([past_u, u], axis=1)
        k0 = past_y.shape[1]
        for k in range(k0, k0 + h):
            lags = [y[:, k - i] for i in range(1, n + 1)] + [x[:, k - i] for i in range(n + 1)]
            y[:, k] = np.concatenate(lags, axis=1) @ self.weights
        return y[:, k0:]


def fit(trajectories, context):
    n = {order}
    rows, targets = [], []
    for t in trajectories:
        for k in range(n, len(t)):
            rows.append(np.concatenate([*(t.y[k - i] for i in range(1, n + 1)),
                                        *(t.u[k - i] for i in range(n + 1))]))
            targets.append(t.y[k])
    weights = np.linalg.lstsq(np.array(rows), np.array(targets), rcond=None)[0]
    context.log(1, float(n))
    return Model(weights)
"""
CRASH = "def fit(trajectories, context):\n    raise ValueError('no such luck')\n"
NOISE = """
import numpy as np


class Model:
    def simulate(self, past_u, past_y, u):
        import os
        noise = np.frombuffer(os.urandom(8 * len(u[0])), "<u8") / 2.0**64
        return 1e-9 * noise[None, :, None] + u[:, :, :1]


def fit(trajectories, context):
    return Model()
"""


def arx(order: int) -> str:
    return ARX.replace("{order}", str(order))


@dataclass(frozen=True)
class Scripted:
    """Proposes the given sources in order."""

    sources: tuple[str, ...]
    name: str = "scripted"

    def propose(self, view: AgentView) -> Proposal | None:
        index = len(view.trials) - 1
        if index >= len(self.sources):
            return None
        return Proposal(self.sources[index], "scripted", f"number {index}", "scripted", "scripted")


def write_problem(
    directory: Path, *, experiments: int = 4, test: bool = True, retests: int = 0
) -> Path:
    """Second-order linear system with a little noise, as CSV files."""
    rng = np.random.default_rng(1)
    directory.mkdir(parents=True)
    for name, length in (("train", 240), ("test", 120)):
        u = rng.normal(size=length)
        y = np.zeros(length)
        for k in range(2, length):
            y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * u[k] + 0.2 * u[k - 1]
        table = np.stack([u, y + 0.01 * rng.normal(size=length)], axis=1)
        np.savetxt(directory / f"{name}.csv", table, delimiter=",", header="u,y", comments="")
    (directory / "baseline.py").write_text(arx(1))
    sealed = 'test = ["test.csv"]' if test else ""
    (directory / "problem.toml").write_text(
        'name = "toy"\nsampling_time = 0.5\ninputs = ["u"]\noutputs = ["y"]\n'
        f'[data]\ntrain = ["train.csv"]\n{sealed}\n'
        "[protocol]\npast_inputs = 3\npast_outputs = 3\n"
        f"[budget]\nexperiments = {experiments}\nfit_seconds = 20\n"
        f"retests = {retests}\n"
    )
    return directory


def search_toy(root: Path, *sources: str, **settings: Any) -> Path:
    """Search the problem `toy` of a folder, which is made where it is missing, with the baseline
    and these sources in its folder `runs`; return the run directory."""
    problem = root / "toy"
    if not problem.is_dir():
        write_problem(problem, experiments=1 + len(sources))
    agent = Scripted(sources)
    ready = prepare(load_problem(problem), agent.name, seed=0, runs=root / "runs", **settings)
    search(ready, agent, lambda event, view: None, lambda view: None)
    return ready.directory
