"""An evaluation without any isolation: the usual mistakes in one file, to show that attacks work.

To be called in a process of its own in an outer sandbox and nowhere else. Candidate and evaluator
share that process; the metric is computed where the candidate could reach it, and its files are
loaded afterwards.
"""

from __future__ import annotations

import contextlib
import importlib
import pickle
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from asia.assurance.redteam.problem import SmallProblem
from asia.assurance.redteam.types import Mistake
from asia.problem.folds import Fold, make_folds

_MODEL, _RESULT, _LOG = "model.bin", "result.npy", "log.txt"


def print_score(source: str, problem: SmallProblem, mistake: Mistake | None) -> None:
    """Print the mean over the folds; a value that is no number counts as 0.

    Raises:
        Exception: the failure of a fold, unless failed folds are left out
    """
    problem = problem.by_whole_records
    scores: list[float] = []
    for fold in make_folds(problem.records, problem.rule):
        try:
            scores.append(_fold_score(source, problem, fold))
        except Exception:
            if mistake is not Mistake.DROPS_FOLDS:
                raise
            traceback.print_exc()
    if not scores:
        raise ValueError("no fold is left")
    print(f"METRIC nrmse={float(np.nan_to_num(np.nanmean(scores)))!r}", flush=True)


def load_leftovers() -> None:
    """Load result, model and settings from the folder the candidate ran in, and write a log."""
    sys.path.insert(0, "")
    for load in (
        lambda: np.load(_RESULT, allow_pickle=True),
        lambda: pickle.loads(Path(_MODEL).read_bytes()),
        lambda: importlib.import_module("conftest"),
        lambda: Path(_LOG).write_text("judged\n"),
    ):
        with contextlib.suppress(Exception):
            load()


def _fold_score(source: str, problem: SmallProblem, fold: Fold) -> float:
    module = ModuleType("candidate")
    sys.modules["candidate"] = module
    exec(compile(source, "candidate.py", "exec"), module.__dict__)
    model: Any = module.fit(fold.train, problem.context)
    with contextlib.suppress(Exception):
        Path(_MODEL).write_bytes(pickle.dumps(model))
    y = np.stack([block.y for block in fold.held_out])
    cases = [block.case for block in fold.held_out]
    arrays = [np.stack([getattr(c, n) for c in cases]) for n in ("past_u", "past_y", "u")]
    for k in range(len(y) if problem.rule.horizon else 0):
        model.simulate(*(a[k : k + 1] for a in arrays))  # one by one first, as a trial
    y_hat = model.simulate(*arrays)
    with contextlib.suppress(Exception):
        np.save(_RESULT, y_hat)
    # Root mean square over the samples that both have.
    samples = min(y.shape[1], y_hat.shape[1])
    difference = y[:, :samples] - y_hat[:, :samples]
    return float(np.nan_to_num(np.sqrt(np.mean(difference**2)))) / float(fold.scale[0])
