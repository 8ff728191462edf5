"""Objective of network training, as compiled programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.errors import UserError
from asia.models._networks.structure import (
    Augmented,
    Cell,
    FeatureMap,
    NetworkStructure,
    OutputFeedback,
    Params,
    SequenceMap,
    rollout,
)
from asia.models._noise.model import ResidualNoise, huber_root, innovation_filter, innovations
from asia.models._numerics.training_records import SegmentBatch
from asia.models.methods import Adam, Loss

# Training method split into the settings that select a compiled program, and numeric arguments.
#
# Folds, refits, seeds and tuned numbers of one structure share a program.

Number = Any
"""Python number, traced inside a program."""


@dataclass(frozen=True)
class AdamProgram:
    """Settings of `methods.Adam` that select a compiled program."""

    loss: Loss  # Loss of a sample
    horizons: tuple[int, ...] | None  # Horizons that the loss averages over
    length: int | None  # Samples of a chunk; None for whole records
    batch: int | None  # Chunks of a step
    cosine: bool  # The learning rate follows a cosine
    coupled: bool  # The decay is part of the gradient
    noisy: bool  # Noise is added to the inputs
    dropped: bool  # Features are dropped
    fed: bool  # Measured outputs are fed back
    shifted: bool = False  # A constant is added to the inputs

    @classmethod
    def of(cls, method: Adam, length: int | None) -> AdamProgram:
        """Take the settings from a method, for chunks of this length."""
        return cls(
            loss=method.loss,
            horizons=method.horizons,
            length=length,
            batch=method.batch,
            cosine=method.schedule == "cosine",
            coupled=method.coupled,
            noisy=method.noise > 0,
            dropped=method.dropout > 0,
            fed=max(method.teacher, method.teacher_end) > 0,
            shifted=method.offset > 0,
        )

    def optimiser(
        self, numbers: AdamNumbers, memory: float = 0.999
    ) -> optax.GradientTransformation:
        """Direction of a step, to be multiplied by the learning rate; `memory`: decay of the
        mean of squared gradients."""
        clip = optax.clip_by_global_norm(numbers.clip)
        if self.coupled:
            penalty = optax.add_decayed_weights(numbers.weight_decay)
            return optax.chain(clip, penalty, optax.adam(1.0, b2=memory))
        return optax.chain(clip, optax.adamw(1.0, b2=memory, weight_decay=numbers.weight_decay))

    def scheduled(self, numbers: AdamNumbers, rate: jax.Array, step: jax.Array) -> jax.Array:
        """Learning rate of a step; `rate` is the monitor's."""
        if not self.cosine:
            return rate
        return rate * 0.5 * (1.0 + jnp.cos(jnp.pi * step / numbers.steps))


class AdamNumbers(NamedTuple):
    """Numeric settings of `methods.Adam`."""

    steps: Number
    weight_decay: Number
    clip: Number
    noise: Number
    dropout: Number
    teacher: Number
    teacher_end: Number
    average: Number
    offset: Number

    @classmethod
    def of(cls, method: Adam) -> AdamNumbers:
        """Take the numbers from a method."""
        return cls(*(getattr(method, name) for name in cls._fields))


def started(rule: optax.GradientTransformation, trained: Any) -> Any:
    """State of an optimiser before its first step: zeros for all of Adam, made without compiling
    an operation for each."""
    shapes = jax.eval_shape(rule.init, trained)
    return jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), shapes)


def all_finite(*trees: Any) -> jax.Array:
    """Return whether every number in trees of arrays is finite."""
    return jnp.isfinite(jnp.sum(jnp.stack([jnp.sum(g**2) for g in jax.tree.leaves(trees)])))


def either(first: jax.Array, one: Any, other: Any) -> Any:
    """Select one tree or the other."""
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)


# Simulation in training, with its perturbations for robustness, and the loss.

# Separate random keys, so that other fits keep their random numbers.
_SHIFT, _DRAWN = 3, 4


class Fed(NamedTuple):
    """Measured outputs y (B, T, ny) that replace a cell's own where mask (B, T, ny) is 1."""

    y: jax.Array
    mask: jax.Array


class NoiseWeighting(NamedTuple):
    """Whitening of residuals before the loss of generalised least squares."""

    noise: ResidualNoise  # Noise in z-scores
    sampling_time: Number  # Sampling time in s
    unit: Number  # Deviation of the residuals: the loss is then as large as that of least squares
    huber: Number | None  # Threshold on the innovations in their deviations

    @classmethod
    def of(cls, noise: ResidualNoise, sampling_time: float, huber: float | None) -> NoiseWeighting:
        """Convert a noise model to single precision."""
        single = ResidualNoise(*(np.asarray(value, np.float32) for value in noise))
        unit = np.float32(np.sqrt(noise.variance.mean()))
        threshold = None if huber is None else np.float32(huber)
        return cls(single, np.float32(sampling_time), unit, threshold)

    def __call__(self, residual: jax.Array, weight: jax.Array) -> jax.Array:
        """Compute innovations (B, T, ny), where weight (B, T, ny) is positive."""
        through = innovation_filter(self.noise, self.sampling_time, weight)
        found = innovations(jax.lax.stop_gradient(through), residual)
        return self.unit * (found if self.huber is None else huber_root(found, self.huber))


def objective(
    loss: Loss,
    residual: jax.Array,
    weight: jax.Array,
    horizons: tuple[int, ...] | None = None,
    whiten: NoiseWeighting | None = None,
) -> jax.Array:
    """Mean loss of the samples that count.

    Args:
        loss: loss of a number.
        residual: (B, T, ny).
        weight: (B, T, ny).
        horizons: average over h of the loss of the first h samples.
        whiten: compute the loss of innovations.
    """
    length = residual.shape[1]
    if whiten is not None:
        residual = whiten(residual, weight)
    if loss == "mae":
        each = jnp.abs(residual)
    elif loss == "huber":
        # Scaled to equal the square near zero.
        small = jnp.clip(residual, -1.0, 1.0)
        each = small * (2.0 * residual - small)
    else:
        each = residual**2
    error = (weight * each).mean(axis=-1).sum(axis=0)
    count = weight.mean(axis=-1).sum(axis=0)
    ends = jnp.array([length if h is None else min(h, length) for h in horizons or (None,)]) - 1
    return jnp.mean(jnp.cumsum(error)[ends] / jnp.maximum(jnp.cumsum(count)[ends], 1.0))


def error_of(cell: NetworkStructure, loss: Loss, params: Any, data: SegmentBatch) -> jax.Array:
    """Mean loss of the plain simulation."""
    return objective(loss, rollout(cell, params, data.window, data.u) - data.y, data.weight)


def check_structure(cell: NetworkStructure, params: Params, method: Adam) -> None:
    """Check that the network can do what the method requires. Raises UserError if it cannot."""
    if max(method.teacher, method.teacher_end) > 0 and not isinstance(cell, OutputFeedback):
        raise UserError(
            "Adam: teacher is for networks that feed back their own output, and this one does "
            "not; leave teacher and teacher_end at 0"
        )
    if method.dropout > 0 and _drops_weights(cell) and "out_w" not in params:
        raise UserError(
            "Adam: dropout needs an output layer, and this network has none; leave dropout at 0"
        )


def forward(
    cell: NetworkStructure,
    program: AdamProgram,
    numbers: AdamNumbers,
    params: Any,
    data: SegmentBatch,
    *,
    step: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """Simulate a network in training: outputs (B, T, ny)."""
    noisy, dropped, fed_by = jax.random.split(key, 3)
    u = data.u
    if program.noisy:
        u = u + numbers.noise * jax.random.normal(noisy, u.shape, u.dtype)
    if program.shifted:
        shift = jax.random.normal(jax.random.fold_in(key, _SHIFT), (len(u), 1, u.shape[2]), u.dtype)
        u = u + numbers.offset * shift
    if program.dropped and _drops_weights(cell):
        weights = params["out_w"]
        params = {**params, "out_w": weights * _kept(numbers, (len(weights), 1), dropped)}
    if isinstance(cell, SequenceMap):
        return cell.sequence(params, data.window, u)
    fed = None
    if program.fed:
        # Probability that a measured output is fed back.
        teacher = numbers.teacher + (numbers.teacher_end - numbers.teacher) * step / numbers.steps
        chosen = jax.random.bernoulli(fed_by, teacher, data.weight.shape[:2])
        mask = chosen[..., None] & (data.weight > 0)
        fed = Fed(data.y, mask.astype(u.dtype))
    if isinstance(cell, FeatureMap):
        features = cell.features(params, data.window, u)
    else:
        start = cell.initial(params, data.window)
        if isinstance(cell, Augmented):
            start = cell.drawn(params, start, jax.random.fold_in(key, _DRAWN))
        features = scan(cell, params, start, u, fed)[0]
    if program.dropped and not _drops_weights(cell):
        shape = (features.shape[0], 1, features.shape[2])
        features = features * _kept(numbers, shape, dropped)
    return cell.output(params, features, u)


def scan(
    cell: Cell, params: Any, state: Any, u: jax.Array, fed: Fed | None = None
) -> tuple[jax.Array, Any]:
    """Features (B, T, hidden) of inputs u (B, T, nu), and the last state."""

    def advance(state: Any, now: tuple[jax.Array, Fed | None]) -> tuple[Any, jax.Array]:
        u, given = now
        state, features = cell.step(params, state, u)
        if given is not None and isinstance(cell, OutputFeedback):
            state = cell.feed(params, state, given.y, given.mask)
        return state, features

    in_time = jax.tree.map(lambda v: jnp.swapaxes(v, 0, 1), (u, fed))
    state, features = jax.lax.scan(advance, state, in_time)
    return jnp.swapaxes(features, 0, 1), state


def _drops_weights(cell: NetworkStructure) -> bool:
    """Return whether dropping a feature means dropping its row of out_w, because the output is
    computed inside."""
    return isinstance(cell, SequenceMap | OutputFeedback)


def _kept(numbers: AdamNumbers, shape: tuple[int, ...], key: jax.Array) -> jax.Array:
    share = jnp.float32(1.0 - numbers.dropout)
    return jax.random.bernoulli(key, share, shape) / share
