"""Does an ablation give the gain to the factor that was improved?

Linear systems of second order. In half of the searches the winner has a better model than the
baseline (order 2 instead of 1), in the other half a better training (least squares instead of a
strong ridge). In both the other factor differs in luck alone, so that nothing is the same by its
text. Prints the share of the gain that goes to the true factor, with the real search, sandbox and
`asia validate --ablate`.

    python benchmarks/searches/attribution.py --systems 3
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia import run
from asia.agents import AgentView, Proposal
from asia.analysis.ablation import ablate
from asia.ledger.events import Fit

CANDIDATE = """
import numpy as np


class Model:
    def __init__(self, order, start):
        self.order, self.start, self.weights = order, start, None

    def rows(self, y, x, k):
        n = self.order
        return [y[:, k - i] for i in range(1, n + 1)] + [x[:, k - i] for i in range(n + 1)]

    def simulate(self, past_u, past_y, u):
        b, h, nu = u.shape
        y = np.concatenate([past_y, np.zeros((b, h, past_y.shape[2]))], axis=1)
        x = np.concatenate([past_u, u], axis=1)
        k0 = past_y.shape[1]
        for k in range(k0, k0 + h):
            y[:, k] = np.concatenate(self.rows(y, x, k), axis=1) @ self.weights
        return y[:, k0:]


def build_model(context):
    return Model({order}, np.random.default_rng([context.seed, {model_luck}]).normal())


def train(model, trajectories, context):
    phi, targets = [], []
    for t in trajectories:
        for k in range(model.order, len(t)):
            phi.append(np.concatenate(model.rows(t.y[None], t.u[None], k), axis=1)[0])
            targets.append(t.y[k])
    phi, targets = np.array(phi), np.array(targets)
    size = np.eye(phi.shape[1])
    weights = np.linalg.solve(phi.T @ phi + {ridge} * size, phi.T @ targets)
    luck = np.random.default_rng([context.seed, {luck}]).normal(size=weights.shape)
    model.weights = weights * (1 + 0.003 * (luck + model.start))
    return model


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
"""


def candidate(order: int, ridge: float, luck: int) -> str:
    """Its source; luck: what tells the draws of two candidates apart."""
    pairs = {"order": order, "ridge": ridge, "luck": luck, "model_luck": 10 + luck}
    source = CANDIDATE
    for name, value in pairs.items():
        source = source.replace("{" + name + "}", str(value))
    return source


@dataclass(frozen=True)
class One:
    """Proposes one candidate."""

    source: str
    name: str = "one"

    def propose(self, view: AgentView) -> Proposal | None:
        """The candidate, once."""
        if len(view.trials) > 1:
            return None
        return Proposal(self.source, "arx", "better", "one factor is better", "lower", 1)


def write_problem(directory: Path, seed: int, baseline: str) -> Path:
    """A second-order system of its own for each seed."""
    random = np.random.default_rng(seed)
    directory.mkdir(parents=True)
    radius, angle = random.uniform(0.6, 0.85), random.uniform(0.4, 1.2)
    u = random.normal(size=300)
    y = np.zeros((300, 1))
    for k in range(2, 300):
        y[k] = 2 * radius * np.cos(angle) * y[k - 1] - radius**2 * y[k - 2]
        y[k] += 0.4 * u[k] + 0.2 * u[k - 1]
    table = np.column_stack([u, y + 0.01 * random.normal(size=y.shape)])
    np.savetxt(directory / "train.csv", table, delimiter=",", header="u,y", comments="")
    (directory / "baseline.py").write_text(baseline)
    (directory / "problem.toml").write_text(
        'name = "one_factor"\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\n[protocol]\npast_inputs = 3\npast_outputs = 3\n'
        "[budget]\nexperiments = 2\n"
    )
    return directory


def main() -> None:
    """One row a search."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--systems", type=int, default=3)
    options.add_argument("--seeds", type=int, default=3)
    asked = options.parse_args()
    print("| system | improved | gain | to the model | to the training | to both together |")
    print("|---|---|---|---|---|---|")
    least = float("inf")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(asked.systems):
            for factor in ("model", "training"):
                ridge, order = (300.0, 2) if factor == "training" else (0.0, 1)
                root = Path(folder) / f"{factor}{seed}"
                problem = write_problem(root / "problem", seed, candidate(order, ridge, 0))
                done = run(problem, agent=One(candidate(2, 0.0, 1)), runs=root / "runs")
                found, _ = ablate(done.directory, _quiet, seeds=asked.seeds)
                parts = found.crossing
                if parts is None:
                    print(f"| {seed} | {factor} | {found.detail} | | | |", flush=True)
                    least = 0.0
                    continue
                shares = [parts.share(p) for p in (parts.model, parts.training, parts.interaction)]
                least = min(least, shares[factor == "training"] or 0.0)
                cells = " | ".join("-" if s is None else f"{100 * s:.1f} %" for s in shares)
                print(f"| {seed} | {factor} | {parts.gain.value:.4f} | {cells} |", flush=True)
    print(f"\nThe true factor gets at least {100 * least:.1f} %.")


def _quiet(event: Fit, done: int, total: int) -> None:
    del event, done, total


if __name__ == "__main__":
    main()
