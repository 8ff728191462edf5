"""Measured gains of the expert's moves, from the ledgers of recorded searches.

python benchmarks/searches/gains.py runs/* --write src/asia/agents/library/gains.csv

A row holds a move and the evidence that it was made on: `overfit` (V is more than twice the
training error), else `coloured` (autocorrelation of the residual above 0.5), else `plain`. The gain
is the share of the parent's V that the move took away, 0 where V rose or the fit failed. The
seconds are processor seconds of the fits over those of the parent's. Runs of one problem with one
seed count once for each proposal. Prints the rows, and how well they predict the gains of each
problem when its own searches are left out, against one gain for all moves.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia.agents.expert.moves import all_moves
from asia.agents.library.gains import PRIOR_TRIALS, evidence_of, name_of
from asia.errors import UserError
from asia.ledger.artifacts import Store
from asia.ledger.run import open_run
from asia.problem.load import load_lock
from asia.search.agent_views import agent_view, problem_facts


@dataclass(frozen=True)
class Made:
    """A move that was made, and its outcome."""

    problem: str
    move: str
    evidence: str
    gain: float
    seconds: float


def main() -> None:
    """Print, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--write", type=Path, help="file of the table")
    options = parser.parse_args()
    found: dict[tuple[str, str, str], Made] = {}
    for run in options.runs:
        try:
            found |= moves_of(run)
        except UserError as error:
            print(f"{run} left out: {error}", file=sys.stderr)
    made = list(found.values())
    rows = [("move", "evidence", "trials", "gain", "spread", "seconds")]
    groups: dict[tuple[str, str], list[Made]] = defaultdict(list)
    for one in made:
        groups[one.move, one.evidence].append(one)
    for (move, evidence), own in sorted(groups.items()):
        gains, seconds = [o.gain for o in own], np.median([o.seconds for o in own])
        numbers = np.mean(gains), np.std(gains), seconds
        rows.append((move, evidence, str(len(own)), *(f"{n:.3g}" for n in numbers)))
    csv.writer(sys.stdout, lineterminator="\n").writerows(rows)
    if options.write:
        with options.write.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
    print_left_out(made)


def moves_of(run: Path) -> dict[tuple[str, str, str], Made]:
    """Moves of one search by problem, parent's and own source."""
    opened = open_run(run)
    problem = load_lock(run / "problem.lock.toml")
    view = agent_view(problem_facts(problem), opened.view, Store(run / "artifacts"))
    trials = {trial.number: trial for trial in view.trials}
    spent = {
        e.number: sum(one.processor for one in e.result.spent)
        for e in opened.view.finished
        if e.result is not None
    }
    names = {move.name for move in all_moves()}
    found: dict[tuple[str, str, str], Made] = {}
    for trial in trials.values():
        parent, name = trials.get(trial.parent or 0), name_of(trial.title, names)
        if parent is None or parent.value is None or not name:
            continue
        gain = 0.0 if trial.value is None else max(0.0, 1.0 - trial.value / parent.value)
        ratio = spent[trial.number] / max(spent[parent.number], 1e-3)
        one = Made(opened.view.started.problem, name, evidence_of(parent), gain, ratio)
        found[one.problem, parent.source, trial.source] = one
    return found


def print_left_out(made: list[Made]) -> None:
    """Errors of predicted gains, leave one problem out."""
    errors: dict[str, list[float]] = {"table": [], "one gain for all": []}
    for problem in {one.problem for one in made}:
        rest = [one for one in made if one.problem != problem]
        if not rest:
            continue
        mean = float(np.mean([one.gain for one in rest]))
        for one in (one for one in made if one.problem == problem):
            key = one.move, one.evidence
            own = [o.gain for o in rest if (o.move, o.evidence) == key]
            shrunk = (PRIOR_TRIALS * mean + sum(own)) / (PRIOR_TRIALS + len(own))
            errors["table"].append(one.gain - shrunk)
            errors["one gain for all"].append(one.gain - mean)
    problems = len({one.problem for one in made})
    print(f"\n{len(made)} moves on {problems} problems; RMSE of gains, leave one problem out:")
    for name, values in errors.items():
        print(f"{name}: {np.sqrt(np.mean(np.square(values))):.4f}")


if __name__ == "__main__":
    main()
