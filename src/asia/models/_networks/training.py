"""Training of networks: objective, programs, method."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np

from asia.candidate import Context, Model
from asia.models._config import Progress
from asia.models._networks import adam, lbfgs, shooting
from asia.models._networks.monitor import Monitor, Scorer
from asia.models._networks.objective import NoiseWeighting, error_of
from asia.models._networks.structure import NetworkStructure, Params, rollout
from asia.models._noise.model import LEAST_DEVIATION, NoiseChoice, estimate_noise
from asia.models._numerics.segments import laid, whole
from asia.models._numerics.training_records import (
    ScaledData,
    SegmentBatch,
    batch,
    batch_weight,
    holdout_masks,
    holdout_records,
    reweighted,
)
from asia.models.methods import LBFGS, Adam, NetworkMethod

_error = jax.jit(error_of, static_argnums=(0, 1))
_rollout = jax.jit(rollout, static_argnums=0)


@dataclass(frozen=True)
class HoldoutSplit:
    """Training samples of a fit that holds some out."""

    fitted: SegmentBatch  # Samples of the fit while the number of steps is searched
    held_out: SegmentBatch  # Samples that decide the number of steps
    full: SegmentBatch  # Samples of the final fit


@dataclass(frozen=True)
class FitTask:
    """Network, training samples and settings of a fit."""

    structure: NetworkStructure  # Structure of the network
    samples: HoldoutSplit | SegmentBatch  # Training samples
    horizon: int | None  # Horizon in samples; None for whole records
    seed: int  # Seed of the random draws of training
    log: Progress  # Receives the progress
    score: Scorer | None = None  # Score of the protocol's early stopping; None where it has none
    sampling_time: float = 1.0  # Sampling time in s


def fit(
    structure: NetworkStructure,
    params: Params,
    records: ScaledData,
    context: Context,
    method: NetworkMethod,
    model_of: Callable[[Params], Model] | None = None,
    copies: int = 1,
) -> Params:
    """Train float32 parameters from initial ones.

    `model_of` makes the model for `context.validation_score`; `copies` successive records are
    transformations of one, which are held out together.
    """
    oracle = context.validation_score
    score: Scorer | None = None
    if method.stop == "validation" and oracle and model_of:

        def validation(params: Params) -> float:
            return oracle(model_of(params))

        score = validation
    samples: HoldoutSplit | SegmentBatch = batch(records, context)
    if score is None and method.holdout > 0:
        samples = _split(records, context, method.holdout, copies)
    with jax.enable_x64(False):
        seed = context.seed % 2**31
        time = context.sampling_time
        task = FitTask(structure, samples, context.horizon, seed, context.log, score, time)
        return train(task, params, method)


def train(task: FitTask, params: Params, method: NetworkMethod) -> Params:
    """Best parameters by the score, or those after the number of steps that did best on the
    held-out samples, or those after all steps."""
    patience = method.patience if method.stop is not None else None
    if isinstance(task.samples, SegmentBatch):
        start = _start(task, task.samples, params, method)
        method = start.method
        monitor = Monitor(method, task.log, task.score, patience if task.score else None)
        monitor.start(start.params)
        last = _run(task, task.samples, start, method.steps, monitor)
        return last if monitor.best is None else monitor.best
    split = task.samples
    start = _start(task, split.fitted, params, method)
    method = start.method
    held_out = _simulations(task, split.held_out)

    def held_out_error(params: Params) -> float:
        return float(_error(task.structure, method.loss, params, held_out))

    monitor = Monitor(method, task.log, held_out_error, patience)
    _run(task, split.fitted, start, method.steps, monitor)
    again = Monitor(method, task.log, replay=monitor.rates)
    refit = start if start.whiten is None else _start(task, split.full, params, method)
    return _run(task, split.full, refit, monitor.best_step, again)


class _Start(NamedTuple):
    """Initial parameters of a fit, its method, and its weighting of residuals."""

    params: Params
    method: NetworkMethod
    whiten: NoiseWeighting | None = None


def _start(task: FitTask, samples: SegmentBatch, params: Params, method: NetworkMethod) -> _Start:
    """Prepare a fit.

    With a noise model the parameters are those after the first half of the steps without it, and
    the noise is that of their residuals; otherwise all is as given.
    """
    choice = NoiseChoice.of(method)
    if choice is None:
        return _Start(params, method)
    half = max(1, method.steps // 2)
    plain = replace(method, steps=half, noise_model="white", huber=None, stop=None)
    params = _run(task, samples, _Start(params, plain), half, Monitor(plain, task.log))
    data = _simulations(task, samples)
    y = np.asarray(_rollout(task.structure, params, data.window, data.u))
    residual, floor = (y - data.y).astype(np.float64), np.full(y.shape[-1], LEAST_DEVIATION)
    noise = estimate_noise(residual, data.weight, task.sampling_time, choice, floor)
    whiten = NoiseWeighting.of(noise, task.sampling_time, choice.huber)
    return _Start(params, replace(method, steps=max(1, method.steps - half)), whiten)


def _simulations(task: FitTask, samples: SegmentBatch) -> SegmentBatch:
    return whole(samples) if task.horizon is None else laid(samples, task.horizon)


def _run(
    task: FitTask, samples: SegmentBatch, start: _Start, steps: int, monitor: Monitor
) -> Params:
    cell, horizon, method, params = task.structure, task.horizon, start.method, start.params
    if isinstance(method, LBFGS):
        return lbfgs.run(cell, params, samples, method, horizon, steps, monitor, start.whiten)
    if isinstance(method, Adam):
        return adam.run(
            cell, params, samples, method, horizon, task.seed, steps, monitor, start.whiten
        )
    return shooting.run(cell, params, samples, method, steps, monitor)


def _split(records: ScaledData, context: Context, fraction: float, copies: int) -> HoldoutSplit:
    full = batch(records, context)
    originals = holdout_records(len(records) // copies, fraction)
    chosen = [copies * i + k for i in originals for k in range(copies)]
    if chosen:
        kept = [r for i, r in enumerate(records) if i not in chosen]
        return HoldoutSplit(
            batch(kept, context), batch([records[i] for i in chosen], context), full
        )
    masks = holdout_masks(records, fraction, shortest=context.horizon or 0)
    fitted, held_out = (
        full._replace(weight=batch_weight(reweighted(records, masks, keep), context))
        for keep in (False, True)
    )
    return HoldoutSplit(fitted, held_out, full)
