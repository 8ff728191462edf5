"""Training method split into the settings that select a compiled program, and numeric arguments.

Folds, refits, seeds and tuned numbers of one structure share a program.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from asia.models.methods import Adam, Loss

Number = Any
"""Python number, traced inside a program."""


@dataclass(frozen=True)
class AdamProgram:
    """Settings of `methods.Adam` that select a compiled program."""

    loss: Loss
    """Loss of a sample."""
    horizons: tuple[int, ...] | None
    """Horizons that the loss averages over."""
    length: int | None
    """Samples of a chunk; None for whole records."""
    batch: int | None
    """Chunks of a step."""
    cosine: bool
    """The learning rate follows a cosine."""
    coupled: bool
    """The decay is part of the gradient."""
    noisy: bool
    """Noise is added to the inputs."""
    dropped: bool
    """Features are dropped."""
    fed: bool
    """Measured outputs are fed back."""
    shifted: bool = False
    """A constant is added to the inputs."""

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
    washout: Number
    offset: Number

    @classmethod
    def of(cls, method: Adam) -> AdamNumbers:
        """Take the numbers from a method."""
        return cls(*(getattr(method, name) for name in cls._fields))

    def teacher_at(self, step: jax.Array) -> jax.Array:
        """Probability that a measured output is fed back."""
        return self.teacher + (self.teacher_end - self.teacher) * step / self.steps


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
