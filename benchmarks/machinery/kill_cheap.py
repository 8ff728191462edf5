"""A search whose experiments cost milliseconds, for `kill.py` and `kill_cluster.py`.

python benchmarks/machinery/kill_cheap.py PROBLEM --runs DIR --experiments N --seed S
    [--isolation LEVEL] [--parallel N] [--executor NAME]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from asia.agents import AgentView, Proposal
from asia.errors import AsiaError
from asia.judge.executors import make_executor
from asia.judge.sandbox.types import Isolation
from asia.problem.load import load_problem
from asia.search.run import prepare, search

NAME = "killed"
ARX = """
import numpy as np


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        y = np.concatenate([past_y, np.zeros((*u.shape[:2], past_y.shape[2]))], axis=1)
        x = np.concatenate([past_u, u], axis=1)
        for k in range(past_y.shape[1], y.shape[1]):
            lags = [y[:, k - i] for i in range(1, ORDER + 1)]
            lags += [x[:, k - i] for i in range(DELAY, ORDER + 1)]
            y[:, k] = np.clip(np.concatenate(lags, axis=1) @ self.weights, -100.0, 100.0)
        return y[:, past_y.shape[1]:]


def fit(trajectories, context):
    rows, targets = [], []
    for t in trajectories:
        for k in range(ORDER, len(t)):
            lags = [t.y[k - i] for i in range(1, ORDER + 1)]
            lags += [t.u[k - i] for i in range(DELAY, ORDER + 1)]
            rows.append(np.concatenate(lags))
            targets.append(t.y[k])
    x, y = np.array(rows), np.array(targets)
    ridge = RIDGE * np.eye(x.shape[1])
    context.log(1, float(len(x)))
    print("order", ORDER)
    return Model(np.linalg.solve(x.T @ x + ridge, x.T @ y))
"""


def arx(order: int, delay: int, ridge: float) -> str:
    """Linear regression on `order` past outputs and inputs."""
    values = {"ORDER": order, "DELAY": delay, "RIDGE": ridge}
    text = ARX
    for name, value in values.items():
        text = text.replace(name, repr(value))
    return text


SOURCES = (
    arx(1, 0, 0.0),
    arx(2, 0, 0.0),
    "def fit(trajectories, context):\n    raise ValueError('on purpose')\n",
    arx(3, 1, 1e-3),
    arx(2, 0, 0.0) + "# the same again\n",
    arx(4, 0, 1e-3),
    "import os\n\n\ndef fit(trajectories, context):\n    os._exit(3)\n",
    arx(5, 1, 1e-2),
    arx(3, 0, 1e-2),
    "def fit(:\n",
    arx(5, 0, 1e-4),
    arx(4, 1, 0.1),
    arx(2, 1, 1.0),
    arx(1, 1, 1e-6),
)


@dataclass(frozen=True)
class Cheap:
    """Proposes `SOURCES` in order, again and again with another constant, whatever runs."""

    name: str = "cheap"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal:
        """As every agent."""
        round_, place = divmod(len(view.proposed) - 1, len(SOURCES))
        source = SOURCES[place] + f"ROUND = {round_}\n" * bool(round_)
        return Proposal(
            source,
            family="arx",
            title=f"number {place}",
            hypothesis="It is cheap.",
            expected="Anything.",
            parent=1,
        )


def main() -> None:
    """Search, or go on with it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("problem")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--experiments", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--isolation", type=Isolation)
    parser.add_argument("--parallel", type=int, default=1)
    parser.add_argument("--executor", default="local")
    options = parser.parse_args()
    problem = load_problem(options.problem)
    budget = replace(problem.budget, experiments=options.experiments, patience=10_000)
    agent = Cheap()
    try:
        prepared = prepare(
            replace(problem, budget=budget),
            agent.name,
            seed=options.seed,
            runs=options.runs,
            name=NAME,
            isolation=options.isolation,
            parallel=options.parallel,
        )
        executor = make_executor(options.executor)
        search(prepared, agent, lambda event, view: None, lambda view: None, executor)
    except AsiaError as error:
        sys.exit(f"asia: {error}")


if __name__ == "__main__":
    main()
