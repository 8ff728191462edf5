"""Use what a search found: simulate with its models, in the sandbox they were made in."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np

from asia.data import Array
from asia.errors import UserError
from asia.ledger import Run, Use, model_to_use, open_run
from asia.problem.load import load_lock
from asia.protocol import Block, Case
from asia.search._run import LOCK, make_evaluator
from asia.search.final.members import final_members


def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
) -> Array:
    """Open-loop simulation with the winner of a run.

    past_u (n_past_u, nu), past_y (n_past_y, ny): the samples just before the first simulated one;
    u (H, nu); physical units -> y_hat (H, ny). model: `ensemble`, the mean of the winner's fold
    models; `refit`, the winner fitted on all training records; `stack`, a weighted mean of several
    experiments; None for the one that the search names as the model to use. Raises UserError for a
    wrong shape or when the run has no such model, CandidateError when the simulation fails.
    """
    run = open_run(Path(directory))
    members = final_members(run.view, _named(run, model))
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
    evaluator = make_evaluator(problem, run.view)
    y_hat = np.zeros_like(block.y)
    for member in members:
        models = [run.store.get(one) for one in member.models]
        replies = evaluator.simulate(run.store.text(member.source), models, [block])
        y_hat += member.weight * np.mean([reply[0] for reply in replies], axis=0)
    return y_hat


def _named(run: Run, model: Use | None) -> Use:
    """The model that is asked for, or else the one to use. Raises UserError where there is none."""
    known = get_args(Use)
    if model is not None and model not in known:
        raise UserError(f"model is {model!r}, expected None or one of {', '.join(known)}")
    chosen = model_to_use(run.view)
    if chosen is None:
        raise UserError(f"run '{run.name}' has no scored model")
    return model or chosen.model
