"""Common parts of the models and steps of several families, batch first, for NumPy and JAX."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np

from asia.candidate import Context, Model, StepModel
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace


class FittedModel(Model, StepModel, Protocol):
    """Result of training that simulates in physical units, at once and step by step."""


C = TypeVar("C")
F = TypeVar("F", bound=FittedModel)


class WrappedModel(Generic[F]):
    """Model that simulates by the fitted model inside."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny).

        Raises:
            UserError: before training.
        """
        return self._trained().simulate(past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        return self._trained().initial(past_u, past_y, u)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        return self._trained().step(state, u)

    def _trained(self) -> F:
        raise NotImplementedError


@dataclass(frozen=True)
class TrainableModel(WrappedModel[F], Generic[C, F]):
    """Settings of a family, and the fitted model that simulates."""

    label: ClassVar[str]
    """Name of the model in messages."""
    config: C
    """Settings of the family."""
    fitted: F | None = None
    """Result of training; None before."""

    @classmethod
    def build(cls, config: C, context: Context) -> Self:
        """Build an untrained model."""
        del context
        return cls(config)

    def _trained(self) -> F:
        if self.fitted is None:
            raise UserError(f"{self.label}: not trained yet; call train first")
        return self.fitted


def first_of_line(past: AnyArray, u: AnyArray, delay: int) -> AnyArray:
    """Last `delay` inputs (B, delay, nu) before the first sample, the oldest first.

    Before the first known input it is held backwards, as in
    `asia.models._numerics.training_records.delayed`.

    Args:
        past: past inputs (B, n_past_u, nu).
        u: first input (B, nu).
        delay: in samples.
    """
    known = namespace(past, u).concatenate([past, u[:, None]], axis=1)
    length = past.shape[1]
    return known[:, np.maximum(np.arange(length - delay, length), 0)]


def through_line(line: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Advance the delay line (B, delay, nu) by an input u (B, nu); return the input (B, nu) that
    acts now too."""
    known = namespace(line, u).concatenate([line, u[:, None]], axis=1)
    return known[:, 1:], known[:, 0]


def mean(values: Sequence[AnyArray]) -> AnyArray:
    """Mean of arrays of one shape."""
    return sum(values[1:], values[0]) / len(values)
