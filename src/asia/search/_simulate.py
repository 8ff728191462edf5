"""Use what a search found: simulate with its models, in the sandbox they were made in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args, overload

import numpy as np
from numpy.typing import NDArray

from asia.data import Array, filled
from asia.errors import UserError
from asia.evaluation import Evaluator
from asia.ledger import Run, Use, model_to_use, open_run
from asia.problem.load import Problem, load_lock
from asia.protocol import Block, Case
from asia.search._run import LOCK, make_evaluator
from asia.search.final.bands import band_basis, models_behind
from asia.search.final.members import FinalMember, final_members


@dataclass(frozen=True)
class BandedSimulation:
    """A simulation with its output bands."""

    y_hat: Array
    """Simulated outputs (H, ny), physical units."""
    lower: Array
    """Lower edge of the bands (H, ny)."""
    upper: Array
    """Upper edge of the bands (H, ny)."""
    level: float
    """The share of measured outputs that the bands are meant to hold."""
    outside: NDArray[np.bool_]
    """Mask of the samples (H,) outside the region of validity: a signal is far beyond its training
    range, an input changes faster than it did there, or inputs and simulated outputs are together
    farther from the mean than 99 % of the training samples. The bands are wider there.
    """


@overload
def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
) -> Array: ...


@overload
def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
    *,
    bands: float,
) -> BandedSimulation: ...


def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
    *,
    bands: float | None = None,
) -> Array | BandedSimulation:
    """Open-loop simulation with the winner of a run.

    past_u (n_past_u, nu), past_y (n_past_y, ny): the samples just before the first simulated one;
    u (H, nu); physical units -> y_hat (H, ny). With [preprocess] all are in the units and at the
    rate of the records: past_u then has n_past_u decimate + the longest delay samples, past_y
    n_past_y decimate. model: `ensemble`, the mean of the winner's fold
    models; `refit`, the winner fitted on all training records; `stack`, a weighted mean of several
    experiments; None for the one that the search names as the model to use. bands: a level such as
    0.9, to have a `BandedSimulation` with the bands that hold this share of the measured outputs.
    Raises UserError for a wrong shape or level or when the run has no such model, CandidateError
    when the simulation fails.
    """
    run = open_run(Path(directory))
    named = _named(run, model)
    members = final_members(run.view, named)
    if bands is not None and not 0.0 < bands < 1.0:
        raise UserError(f"bands is {bands}, expected a share between 0 and 1, such as 0.9")
    problem = load_lock(run.directory / LOCK)
    block = _block(run, problem, past_u, past_y, u)
    evaluator = make_evaluator(problem, run.view)
    each = _simulated(evaluator, run, members, block)
    y_hat = each.mean(axis=0)
    done = problem.preprocess
    if bands is None:
        return done.back(y_hat, problem.channels.outputs, len(u))
    behind = models_behind(run.view, named)
    folds = each if behind == members else _simulated(evaluator, run, behind, block)
    basis = band_basis(evaluator, run.view, run.store, named)
    found, outside = basis.around(block.case, folds, y_hat, bands)
    mean, lower, upper = (
        done.back(edge, problem.channels.outputs, len(u))
        for edge in (y_hat, found.lower, found.upper)
    )
    outside = np.repeat(outside, done.decimate)[: len(u)]
    return BandedSimulation(mean, lower, upper, bands, outside)


def simulate_cases(
    directory: Path | str, cases: Sequence[tuple[Array, Array, Array]], model: Use | None = None
) -> list[Array]:
    """Simulate several cases (past_u, past_y, u) at once, see `simulate`. Return y_hat (H, ny) of
    each.
    """
    run = open_run(Path(directory))
    named = _named(run, model)
    problem = load_lock(run.directory / LOCK)
    blocks = [_block(run, problem, *case, record=k) for k, case in enumerate(cases)]
    evaluator = make_evaluator(problem, run.view)
    members = final_members(run.view, named)
    done, outputs = problem.preprocess, problem.channels.outputs
    simulated = simulate_members(evaluator, run, members, blocks)
    return [
        done.back(each.mean(axis=0), outputs, len(case[2]))
        for each, case in zip(simulated, cases, strict=True)
    ]


def _block(
    run: Run, problem: Problem, past_u: Array, past_y: Array, u: Array, record: int = 0
) -> Block:
    """Return a case as a block.

    Args:
        record: true if cases of different records may be simulated at once.

    Raises:
        UserError: an array has the wrong shape.
    """
    rule, nu, ny = problem.protocol, len(problem.inputs), len(problem.outputs)
    done, every = problem.preprocess, problem.preprocess.decimate
    for name, array, shape in (
        ("past_u", past_u, (rule.past_inputs * every + done.longest_delay, nu)),
        ("past_y", past_y, (rule.past_outputs * every, ny)),
        ("u", u, (len(u), nu)),
    ):
        if np.shape(array) != shape:
            raise UserError(f"{name} has shape {np.shape(array)}, expected {shape}")
    before, past, after = (np.asarray(a, np.float64) for a in (past_u, past_y, u))
    if np.isnan(past).all(axis=0).any() and len(past):
        raise UserError("past_y has an output without a measured sample: give a later start")
    past = filled(past)
    if done:
        # The last input is held until a whole number of samples that a model receives.
        held = np.repeat(after[-1:], -len(after) % every, axis=0)
        whole = done.inputs(np.concatenate([before, after, held]), problem.channels.inputs)
        before, after = whole[: rule.past_inputs], whole[rule.past_inputs :]
        past = done.outputs(past, problem.channels.outputs)
    case = Case(run.name, before, past, after)
    return Block(case, np.zeros((len(after), ny)), record=record, start=0)


def _simulated(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember], block: Block
) -> Array:
    """Simulations (K, H, ny) whose mean is that of the members: one a fold, or that of a refit."""
    return simulate_members(evaluator, run, members, [block])[0]


def simulate_members(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember], blocks: Sequence[Block]
) -> list[Array]:
    """Return for each block simulations (K, H, ny) whose mean is that of the members.

    Raises:
        CandidateError: a member fails.
    """
    total = [np.zeros((1, *block.y.shape)) for block in blocks]
    for member in members:
        models = [run.store.get(one) for one in member.models]
        replies = evaluator.simulate(run.store.text(member.source), models, blocks)
        for place, each in enumerate(zip(*replies, strict=True)):
            total[place] = total[place] + member.weight * np.stack(each)
    return total


def _named(run: Run, model: Use | None) -> Use:
    """The model that is asked for, or else the one to use. Raises UserError where there is none."""
    known = get_args(Use)
    if model is not None and model not in known:
        raise UserError(f"model is {model!r}, expected None or one of {', '.join(known)}")
    chosen = model_to_use(run.view)
    if chosen is None:
        raise UserError(f"run '{run.name}' has no scored model")
    return model or chosen.model
