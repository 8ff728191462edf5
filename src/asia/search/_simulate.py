"""Use what a search found: simulate with its models, in the sandbox they were made in."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from asia.data import Array
from asia.errors import UserError
from asia.ledger import open_run
from asia.problem.load import load_lock
from asia.protocol import Block, Case
from asia.search._run import LOCK, make_evaluator


def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Literal["ensemble", "refit"] = "ensemble",
) -> Array:
    """Open-loop simulation with the winner of a run.

    past_u (n_past_u, nu), past_y (n_past_y, ny): the samples just before the first simulated one;
    u (H, nu); physical units -> y_hat (H, ny). `ensemble` is the mean of the fold models, `refit`
    the winner fitted on all training records. Raises UserError for a wrong shape or when the run
    has no such model, CandidateError when the simulation fails.
    """
    run = open_run(Path(directory))
    best, refitted = run.view.best, run.view.refitted
    if best is None or best.result is None:
        raise UserError(f"run '{run.name}' has no scored model")
    if model == "refit" and (refitted is None or refitted.model is None):
        raise UserError(f"run '{run.name}' has no refitted model")
    problem = load_lock(run.directory / LOCK)
    rule, nu, ny = problem.protocol, len(problem.inputs), len(problem.outputs)
    for name, array, shape in (
        ("past_u", past_u, (rule.past_inputs, nu)),
        ("past_y", past_y, (rule.past_outputs, ny)),
        ("u", u, (len(u), nu)),
    ):
        if np.shape(array) != shape:
            raise UserError(f"{name} has shape {np.shape(array)}, expected {shape}")
    case = Case(run.name, *(np.asarray(a, np.float64) for a in (past_u, past_y, u)))
    block = Block(case, np.zeros((len(u), ny)), record=0, start=0)
    stored = [fold.model for fold in best.result.folds]
    if model == "refit" and refitted is not None and refitted.model is not None:
        stored = [refitted.model]
    source = run.store.text(best.proposed.source)
    evaluator = make_evaluator(problem, run.view)
    replies = evaluator.simulate(source, [run.store.get(m) for m in stored], [block])
    return np.mean([reply[0] for reply in replies], axis=0)
