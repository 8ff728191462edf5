"""Simulation with the models of a run, in the sandbox."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import get_args, overload

import numpy as np
from numpy.typing import NDArray

from asia._progress import tracked
from asia._text import one_line
from asia.data.segment import Segment, SimulatedSegment
from asia.data.trajectory import Array, filled, real_numbers
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.bands import (
    Bands,
    Calibration,
    ErrorSizes,
    HeldOutErrors,
    Region,
    calibrate,
    error_sizes,
    output_bands,
    region_of,
)
from asia.ledger.artifacts import Store
from asia.ledger.events import Use
from asia.ledger.run import Run, model_to_use, open_run
from asia.ledger.simulated import SimulatedCases, simulated_cases
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import Fold, cut, whole
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.problem.protocol import ProtocolRule
from asia.search.run import LOCK, library_digest, make_evaluator


@dataclass(frozen=True)
class FinalMember:
    """Stored models of one candidate; the mean of their simulations counts with a weight."""

    source: str
    models: tuple[str, ...]
    weight: float = 1.0
    """Its share; those of all members add up to 1."""


def final_members(view: SearchView, use: Use) -> tuple[FinalMember, ...]:
    """The members of a final model. Raises UserError where the search has none."""
    run, best, refitted = view.started.run, view.best, view.refitted
    if best is None:
        raise UserError(f"run '{run}' has no scored model")
    if use == "ensemble":
        return (fold_models(best),)
    if use == "refit":
        if refitted is None or refitted.model is None:
            why = f": {refitted.detail}" if refitted and refitted.detail else ""
            raise UserError(f"run '{run}' has no refitted model{why}")
        return (FinalMember(best.source, (refitted.model,)),)
    if refitted is None or refitted.stack is None:
        raise UserError(
            f"run '{run}' has no stack: it is made at the end of a search, where several "
            "candidates together have a lower V than one"
        )
    members = refitted.stack.members
    return tuple(fold_models(view.experiment(m.experiment), m.weight) for m in members)


def has_model(view: SearchView, use: Use) -> bool:
    """Return whether the search has this final model."""
    try:
        return bool(final_members(view, use))
    except UserError:
        return False


def fold_models(experiment: Experiment, weight: float = 1.0) -> FinalMember:
    """The fold models of a scored experiment."""
    models = tuple(fold.model for fold in experiment.folds)
    return FinalMember(experiment.source, models, weight)


# Bands of a final model, from the held-out simulations that the ledger keeps.


BAND_LEVEL = 0.9
"""Coverage of the bands that are drawn and recorded."""

# Share of the differences between the fold models. Held-out errors already contain the variance
# of a fold model; the full differences would count it twice.
_SHARE = 0.5


@dataclass(frozen=True)
class BandBasis:
    """Data for the output bands of one final model."""

    errors: tuple[HeldOutErrors, ...]
    """Held-out errors of the fold models behind the model, NaN for unmeasured outputs."""
    simulated: tuple[tuple[Array, ...], ...]
    """Their simulations (H, ny) of each held-out block, one tuple a fold."""
    region: Region
    """That of all training records."""
    windows: bool
    """True if the protocol simulates windows, so that errors depend on the step."""

    @property
    def noise(self) -> Array:
        """Standard deviation (ny,) of the measurement noise: of the changes of the errors from
        sample to sample, over sqrt 2, which a slow error of the model hardly moves."""
        channels = zip(*(block.T for fold in self.errors for block in fold.blocks), strict=True)
        each = [np.concatenate([np.diff(e[np.isfinite(e)]) for e in one]) for one in channels]
        return np.array([changes.std() / np.sqrt(2.0) for changes in each])

    @cached_property
    def calibration(self) -> Calibration:
        """Check of the bands on folds that did not make them."""
        return calibrate(self.errors, BAND_LEVEL, by_step=self.windows)

    @cached_property
    def _sizes(self) -> ErrorSizes:
        wide = self.calibration.factor
        wider = [HeldOutErrors(tuple(wide * block for block in e.blocks)) for e in self.errors]
        return error_sizes(wider, by_step=self.windows)

    def around(
        self, case: Segment, folds: Array, y_hat: Array, level: float
    ) -> tuple[Bands, NDArray[np.bool_]]:
        """Bands at the level, and whether each sample (H,) is outside the region of validity,
        where the bands are wider in proportion to the distance. folds: the simulations (K, H, ny)
        of the fold models; y_hat (H, ny) that of the final model, which the bands always hold."""
        centres = y_hat + _SHARE * (folds - folds.mean(axis=0))
        distance = self.region.distance(case.past_u, case.u, y_hat)
        wider = np.maximum(distance, 1.0)
        found = output_bands(self._sizes, centres, level, wider)
        bands = Bands(np.minimum(found.lower, y_hat), np.maximum(found.upper, y_hat))
        return bands, distance > 1.0


def models_behind(view: SearchView, use: Use) -> tuple[FinalMember, ...]:
    """The fold models behind a final model: of a stack its members', else the best candidate's."""
    return final_members(view, "stack" if use == "stack" else "ensemble")


def band_basis(evaluator: Evaluator, view: SearchView, store: Store, use: Use) -> BandBasis:
    """The basis for the bands of a final model that the search has."""
    if use == "stack" and view.refitted is not None and view.refitted.stack is not None:
        weights = {m.experiment: m.weight for m in view.refitted.stack.members}
    else:
        assert view.best is not None
        weights = {view.best.number: 1.0}
    parts = [(view.experiment(number).folds, weight) for number, weight in weights.items()]
    simulated: list[tuple[Array, ...]] = []
    errors: list[HeldOutErrors] = []
    for fold in evaluator.data.folds:
        total = [np.zeros(shape) for shape in fold.shapes]
        for folds, weight in parts:
            kept = store.get_arrays(folds[fold.index].y_hat, fold.shapes)
            total = [t + weight * y_hat for t, y_hat in zip(total, kept, strict=True)]
        pairs = zip(fold.held_out, total, strict=True)
        simulated.append(tuple(total))
        errors.append(HeldOutErrors(tuple(b.y - y for b, y in pairs)))
    region = region_of([(r.u, r.y) for r in evaluator.data.records])
    return BandBasis(tuple(errors), tuple(simulated), region, evaluator.data.horizon is not None)


# Use what a search found: simulate with its models, in the sandbox they were made in.


@dataclass(frozen=True)
class BandedSimulation:
    """A simulation with its output bands."""

    y_hat: Array
    """Simulated outputs (H, ny), physical units."""
    lower: Array
    upper: Array
    """Edges of the bands (H, ny); NaN for an output whose band is withdrawn."""
    level: float
    """The share of measured outputs that the bands are meant to hold."""
    outside: NDArray[np.bool_]
    """Mask of the samples (H,) outside the region of validity: a signal is far beyond its training
    range, an input changes faster than it did there, or inputs and simulated outputs are together
    farther from the mean than 99 % of the training samples. The bands are wider there.
    """
    withdrawn: tuple[str, ...]
    """The reason why there is no band, one an output; "" where there is one."""


@overload
def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
    *,
    isolation: Isolation | None = None,
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
    isolation: Isolation | None = None,
) -> BandedSimulation: ...


def simulate(
    directory: Path | str,
    past_u: Array,
    past_y: Array,
    u: Array,
    model: Use | None = None,
    *,
    bands: float | None = None,
    isolation: Isolation | None = None,
) -> Array | BandedSimulation:
    """Open-loop simulation with the best candidate of a run.

    past_u (n_past_u, nu), past_y (n_past_y, ny): the samples just before the first simulated one;
    u (H, nu); physical units -> y_hat (H, ny). With [preprocess] all are in the units and at the
    rate of the records: past_u then has n_past_u decimate + the longest delay samples, past_y
    n_past_y decimate. model: `ensemble`, the mean of the best candidate's fold
    models; `refit`, the best candidate fitted on all training records; `stack`, a weighted mean of
    several experiments; None for the one that the search names as the model to use. bands: a level
    such as 0.9, to have a `BandedSimulation` with the bands that hold this share of the measured
    outputs. isolation: level of the sandbox that executes the candidate; None for the strongest of
    this machine, whatever level the ledger names.
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
    evaluator = make_evaluator(problem, run.view, isolation=isolation)
    (each,) = simulate_members(evaluator, run, members, [block])
    y_hat = each.mean(axis=0)
    done = problem.preprocess
    if bands is None:
        return done.refined(y_hat, len(u))
    behind = models_behind(run.view, named)
    folds = each
    if behind != members:
        (folds,) = simulate_members(evaluator, run, behind, [block])
    basis = band_basis(evaluator, run.view, run.store, named)
    found, outside = basis.around(block, folds, y_hat, bands)
    mean, lower, upper = (done.refined(edge, len(u)) for edge in (y_hat, found.lower, found.upper))
    outside = np.repeat(outside, done.decimate)[: len(u)]
    withdrawn = basis.calibration.withdrawn
    without = np.array([bool(reason) for reason in withdrawn])
    lower, upper = (np.where(without, np.nan, edge) for edge in (lower, upper))
    return BandedSimulation(mean, lower, upper, bands, outside, withdrawn)


def simulate_cases(
    directory: Path | str, cases: Sequence[tuple[Array, Array, Array]], model: Use | None = None
) -> list[Array]:
    """Simulate cases (past_u, past_y, u) at once, see `simulate`; y_hat (H, ny) of each."""
    run = open_run(Path(directory))
    named = _named(run, model)
    problem = load_lock(run.directory / LOCK)
    blocks = [_block(run, problem, *case, record=k) for k, case in enumerate(cases)]
    evaluator = make_evaluator(problem, run.view)
    simulated = simulate_members(evaluator, run, final_members(run.view, named), blocks)
    return [
        problem.preprocess.refined(each.mean(axis=0), len(case[2]))
        for each, case in zip(simulated, cases, strict=True)
    ]


def _block(
    run: Run, problem: Problem, past_u: Array, past_y: Array, u: Array, record: int = 0
) -> Segment:
    """Return a case as a block. Raises UserError for an array of a wrong shape."""
    rule, nu, ny = problem.protocol, len(problem.inputs), len(problem.outputs)
    done, every = problem.preprocess, problem.preprocess.decimate
    for name, array, shape in (
        ("past_u", past_u, (rule.past_inputs * every + done.longest_delay, nu)),
        ("past_y", past_y, (rule.past_outputs * every, ny)),
        ("u", u, (len(u), nu)),
    ):
        if np.shape(array) != shape:
            raise UserError(f"{name} has shape {np.shape(array)}, expected {shape}")
    pairs = (("past_u", past_u), ("past_y", past_y), ("u", u))
    before, past, after = (real_numbers(array, name) for name, array in pairs)
    if np.isnan(past).all(axis=0).any() and len(past):
        raise UserError("past_y has an output without a measured sample: give a later start")
    past = filled(past)
    if done:
        # The last input is held until a whole number of samples that a model receives.
        held = np.repeat(after[-1:], -len(after) % every, axis=0)
        whole = done.inputs(np.concatenate([before, after, held]), problem.inputs)
        before, after = whole[: rule.past_inputs], whole[rule.past_inputs :]
        past = done.outputs(past)
    return Segment(before, past, after, np.zeros((len(after), ny)), run.name, record)


@contextmanager
def loading_stored_models(view: SearchView) -> Generator[None]:
    """Say so where a model fails because another version of the library stored it.

    Raises:
        UserError: in that case
        CandidateError: for any other failure, unchanged
    """
    try:
        yield
    except CandidateError as error:
        broken = error.reason in (Reason.CRASH, Reason.CONTRACT)
        if broken and view.started.environment.get("asia.models") != library_digest():
            raise UserError(
                "the model was stored by another version of ASIA, and this one cannot execute it: "
                "use that version, or run the search again"
            ) from None
        raise


def simulate_members(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember], blocks: Sequence[Segment]
) -> list[Array]:
    """Simulations (K, H, ny) of each block whose mean is that of the members. Raises
    CandidateError, and UserError as `loading_stored_models`."""
    total = [np.zeros((1, *block.y.shape)) for block in blocks]
    for member in tracked(members, "model"):
        models = [run.store.get(one) for one in member.models]
        with loading_stored_models(run.view):
            replies = evaluator.models.simulate(run.store.text(member.source), models, blocks)
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


# A bounded part of what an experiment's models simulate, made anew from the stored models in the
# sandbox: no ledger has to hold it.


_MOST_RECORDS = 4
_MOST_SAMPLES = 4000
_MOST_WINDOWS = 24
_MOST_VALUES = 400_000


def simulated_excerpts(run: Run, number: int, isolation: Isolation | None = None) -> SimulatedCases:
    """Training cases of each fold of experiment `number` and, where the problem shows residuals of
    the held-out part, held-out ones. isolation: as in `simulate`. Raises UserError where it has no
    models."""
    experiment = run.view.experiment(number)
    result, score = experiment.result, experiment.score
    if result is None or score is None:
        raise UserError(f"experiment {number} has no score, so there is nothing to draw")
    problem = load_lock(run.directory / LOCK)
    rule, evaluator = problem.protocol, make_evaluator(problem, run.view, isolation=isolation)
    parts = (1 + (rule.residuals == "held_out")) * len(evaluator.data.folds)
    most = _MOST_VALUES // parts // (2 * len(problem.outputs) + len(problem.inputs))
    source = run.store.text(experiment.source)
    cases: list[tuple[int, bool, SimulatedSegment]] = []
    for index, (fold, kept) in enumerate(zip(evaluator.data.folds, result.folds, strict=True)):
        blocks = training_excerpt(fold, rule, most)
        try:
            with loading_stored_models(run.view):
                (y_hat,) = evaluator.models.simulate(source, [run.store.get(kept.model)], blocks)
        except CandidateError as error:
            raise UserError(
                f"the model of fold {index + 1} cannot be simulated again: {error.reason.advice}"
            ) from None
        cases += simulated_cases(fold, blocks, y_hat, held_out=False)
        if rule.residuals == "held_out":
            stored = run.store.get_arrays(kept.y_hat, fold.shapes)
            places = _spread(fold.held_out, rule, most)
            chosen = [fold.held_out[k] for k in places], [stored[k] for k in places]
            cases += simulated_cases(fold, *chosen, held_out=True)
    return SimulatedCases(
        title=f"Experiment {number}, {one_line(experiment.description, 200)}",
        sampling_time=problem.sampling_time,
        windows=rule.horizon is not None,
        inputs=problem.inputs,
        outputs=problem.outputs,
        cases=tuple(cases),
    )


def training_excerpt(fold: Fold, rule: ProtocolRule, most: int = _MOST_SAMPLES) -> list[Segment]:
    """Some cases of the records that a fold trains on, of `most` samples in all."""
    if rule.horizon is not None:
        blocks = whole(fold.train, rule)
        return [blocks[k] for k in _spread(blocks, rule, most)]
    records = fold.train[:_MOST_RECORDS]
    each = min(most // len(records), _MOST_SAMPLES)
    return [
        cut(record, rule.past, min(len(record), rule.past + each), rule, k)
        for k, record in enumerate(records)
    ]


def _spread(blocks: Sequence[Segment], rule: ProtocolRule, most: int) -> list[int]:
    """Indices of some evenly spaced windows, or of the first complete records."""
    if rule.horizon is None:
        ends = np.cumsum([len(block.y) for block in blocks[:_MOST_RECORDS]])
        return list(range(max(1, int((ends <= most).sum()))))
    count = max(1, min(_MOST_WINDOWS, most // rule.horizon, len(blocks)))
    return np.unique(np.linspace(0, len(blocks) - 1, count).round().astype(int)).tolist()
