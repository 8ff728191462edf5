"""How many experiments does a search keep whose candidates differ in luck alone?

The candidates have the same form and draw their one parameter from the seed, so none is better than
another. The search is the real one, in sandboxes: `--searches` of 50 experiments under the rule of
one fit and under that of retests. A second table has the same rules in the real `judge`, with drawn
scores and no fits, for many more searches.

    python benchmarks/searches/null_search.py --searches 4
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np

from asia import run
from asia.agents import AgentView, Proposal
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.scoring.outcome import FoldRecord, Score
from asia.ledger.events import Evaluated, Event, Proposed, Started
from asia.ledger.view import replay
from asia.problem.load import load_problem
from asia.search.decision import decide

EXPERIMENTS = 50
RULES = {"one fit": 0, "retests": 2}
CANDIDATE = """
import numpy as np


class Model:
    def __init__(self, gain):
        self.gain = gain

    def simulate(self, past_u, past_y, u):
        return self.gain * u


def fit(trajectories, context):
    luck = np.random.default_rng([context.seed, {number}]).normal()
    return Model(0.5 + 0.1 * luck)
"""


@dataclass(frozen=True)
class SeedsOnly:
    """Proposes the same candidate with another number."""

    name: str = "seeds_only"

    def propose(self, view: AgentView) -> Proposal:
        """The next number."""
        number = len(view.trials)
        source = CANDIDATE.replace("{number}", str(number))
        return Proposal(source, "gain", f"number {number}", "it is lucky", "nothing")


def write_problem(directory: Path, retests: int) -> Path:
    """A gain with noise; the baseline is candidate 0."""
    random = np.random.default_rng(1)
    directory.mkdir(parents=True)
    u = random.normal(size=200)
    table = np.stack([u, u + 0.2 * random.normal(size=200)], axis=1)
    np.savetxt(directory / "train.csv", table, delimiter=",", header="u,y", comments="")
    (directory / "baseline.py").write_text(CANDIDATE.replace("{number}", "0"))
    (directory / "problem.toml").write_text(
        'name = "null"\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\n[budget]\n'
        f"experiments = {EXPERIMENTS}\npatience = {EXPERIMENTS}\nretests = {retests}\n"
    )
    return directory


def searched(seed: int, retests: int, root: Path) -> tuple[int, int, float]:
    """Experiments kept, fits in all, and seconds of a real search."""
    problem = write_problem(root / f"null-{seed}-{retests}", retests)
    runs = root / f"runs-{retests}"
    view = run(load_problem(problem), agent=SeedsOnly(), seed=seed, runs=runs).view
    results = [e.result for e in view.finished if e.result]
    fits = sum(1 + len(r.retests) for r in results)
    return sum(r.status == "keep" for r in results), fits, view.seconds


class _Drawn(Evaluator):
    """V of every fit is drawn anew."""

    may_fit_ahead = False

    def __init__(self, random: np.random.Generator, scatter: float) -> None:
        self._random, self._scatter, self.fits = random, scatter, 0
        self.workers = cast(WorkerRunner, SimpleNamespace(is_sequential=True))

    def evaluate(self, source: str, start: int = 0) -> Evaluation:
        """One more draw."""
        del source, start
        self.fits += 1
        value = float(np.exp(self._scatter * self._random.normal()))
        return Evaluation(Score(value, (FoldRecord(value, (), (), (), (), y_hat=str(value)),)))

    def objection(self, source: str, evaluation: object) -> None:
        """None."""


def drawn(random: np.random.Generator, retests: int, scatter: float) -> tuple[int, int]:
    """Experiments kept, and fits in all, of a search whose scores are drawn."""
    none = "0" * 64
    start = Started(
        "null", "null", "drawn", 0, EXPERIMENTS, None, ("y",), none, none, None, "process", (), {},
        retests=retests,
    )  # fmt: skip
    events: list[Event] = [start]
    evaluator, kept = _Drawn(random, scatter), 0
    for number in range(1, EXPERIMENTS + 1):
        view = replay([start, *events[-2:]] if kept else [start])
        found = decide(evaluator, "", view)
        if found.status == "keep":
            kept += 1
            name = str(number)
            events += [
                Proposed(number, None, "explore", "f", name, "h", "e", name, name),
                Evaluated(
                    number, "keep", found.evaluation.outcome, None, 0.0, retests=found.retests
                ),
            ]
    return kept, evaluator.fits


def main() -> None:
    """Both tables."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--searches", type=int, default=2, help="real searches for each rule")
    options.add_argument("--drawn", type=int, default=200, help="drawn searches for each rule")
    asked = options.parse_args()
    print("| search | rule | kept | share | fits an experiment | seconds |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, retests in RULES.items():
            for seed in range(asked.searches):
                kept, fits, seconds = searched(seed, retests, Path(folder))
                share, each = kept / EXPERIMENTS, fits / EXPERIMENTS
                row = f"| real, seed {seed} | {name} | {kept} | {share:.1%} | {each:.2f}"
                print(f"{row} | {seconds:.0f} |", flush=True)
    for scatter in (0.02, 0.3):
        for name, retests in RULES.items():
            random = np.random.default_rng(0)
            found = np.array([drawn(random, retests, scatter) for _ in range(asked.drawn)])
            kept, fits = found.T
            row = f"| {asked.drawn} drawn, scatter {scatter:.0%} | {name} | {kept.mean():.2f}"
            shares = f"{kept.mean() / EXPERIMENTS:.1%}, 95 % of searches at most "
            shares += f"{np.quantile(kept, 0.95) / EXPERIMENTS:.0%}"
            print(f"{row} | {shares} | {fits.mean() / EXPERIMENTS:.2f} | |", flush=True)


if __name__ == "__main__":
    main()
