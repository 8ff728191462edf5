"""Time to equal error on one fold: a candidate of the library against what a user writes by hand.

python benchmarks/by_hand/compare.py [--peer scipy_greybox] [--python PATH] [--repeats 3]

The fold is the first of two_tanks_sim. Ours is the family's first candidate, fitted and scored by
the evaluator in a fresh sandboxed worker. A peer is a script of this folder, run by --python, which
is this Python unless its libraries need another one. It may look at its held-out error as often as
it likes, and stops once it is within 1 % of ours, or after --most seconds. Seconds are those of
fresh processes, from their start: imports and compilation count. Prints medians.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from asia.problem.folds import make_folds
from asia.problem.load import load_problem

HERE = Path(__file__).parent
PROBLEM = "two_tanks_sim"
WITHIN = 1.01
# Peers, and the family of ours that each is compared with.
PEERS = {"scipy_greybox": "greybox", "jax_sysid_rnn": "neural_ss", "torch_gru": "recurrent"}
OURS = """
import sys
from asia.agents.library.registry import family
from asia.candidate import Context
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.problem.load import load_problem
from asia.problem.folds import (make_folds)
from asia.judge.sandbox.availability import probe
from asia.search.agent_views import problem_facts
problem = load_problem(sys.argv[1])
facts, rule = problem_facts(problem), problem.protocol
row = family(sys.argv[2])
context = Context(facts.inputs, facts.outputs, facts.sampling_time, rule.past_inputs,
    rule.past_outputs, rule.horizon, rule.metric, problem.physics, seed=1)
fold = make_folds(problem.train, rule)[:1]
data = EvaluationData(fold, problem.train, context, rule)
evaluator = Evaluator(data, WorkerRunner(probe().level, problem.budget, LocalExecutor(1)))
print("error", evaluator.evaluate(row.trial(facts).source(row.label)).outcome.value)
"""


@dataclass(frozen=True)
class Run:
    """Seconds until the last error that a process printed, and that error."""

    seconds: float
    error: float


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--peer", choices=tuple(PEERS), action="append")
    parser.add_argument("--python", type=Path, default=Path(sys.executable))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--most", type=float, default=300.0, help="seconds a peer may take")
    given = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, medians of {given.repeats}\n")
    print("| peer | ours | error | seconds | error of the peer | seconds | ratio |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        data = Path(name) / "fold.npz"
        for peer in given.peer or PEERS:
            pairs: list[tuple[Run, Run]] = []
            for seed in range(given.repeats):
                ours = last_error([sys.executable, "-c", OURS, PROBLEM, PEERS[peer]], given.most)
                write_fold(data, ours.error * WITHIN, seed)
                command = [str(given.python), str(HERE / f"{peer}.py"), str(data)]
                pairs.append((ours, last_error(command, given.most)))
            print(row(peer, pairs), flush=True)


def row(peer: str, pairs: list[tuple[Run, Run]]) -> str:
    """One line of the table."""
    ours, other = (median(run.seconds for run in column) for column in zip(*pairs, strict=True))
    errors = [median(run.error for run in column) for column in zip(*pairs, strict=True)]
    reached = all(theirs.error <= own.error * WITHIN for own, theirs in pairs)
    ratio = f"{other / ours:.1f}" if reached else f"over {other / ours:.1f}, not reached"
    cells = [peer, PEERS[peer], f"{errors[0]:.4f}", f"{ours:.1f}", f"{errors[1]:.4f}"]
    return f"| {' | '.join([*cells, f'{other:.1f}', ratio])} |"


def last_error(command: list[str], most: float) -> Run:
    """The least error a process prints (in lines `error NUMBER`) and when; it is ended after `most`
    seconds."""
    begin, found = time.monotonic(), Run(float("nan"), float("inf"))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            words, now = line.split(), time.monotonic() - begin
            if words[:1] == ["error"] and float(words[1]) < found.error:
                found = Run(now, float(words[1]))
            if now > most:
                process.kill()
    if process.returncode and time.monotonic() - begin < most:
        sys.exit(f"{command[:2]}: exit code {process.returncode}")
    return found


def write_fold(file: Path, target: float, seed: int) -> None:
    """Write the arguments of a peer: train_u, train_y (T, 1), past_u, past_y (5, 1), u, y (H, 1),
    scale of the error, target error, seed."""
    problem = load_problem(PROBLEM)
    fold = make_folds(problem.train, problem.protocol)[0]
    block = fold.held_out[0]
    assert len(fold.train) == len(fold.held_out) == 1
    np.savez(
        file, train_u=fold.train[0].u, train_y=fold.train[0].y, past_u=block.past_u,
        past_y=block.past_y, u=block.u, y=block.y, scale=fold.scale, target=target,
        seed=seed, sampling_time=problem.sampling_time,
    )  # fmt: skip


if __name__ == "__main__":
    main()
