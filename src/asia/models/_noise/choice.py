"""Settings of a training method for the noise of the outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, get_args

from asia.errors import UserError
from asia.models._config import check_choice, demand, owner

NoiseKind: TypeAlias = Literal["white", "slow"]


class NoiseSettings(Protocol):
    """Settings of a training method that concern noise."""

    @property
    def noise_model(self) -> NoiseKind:
        """Model of the residual of a simulation."""
        ...

    @property
    def slow_time(self) -> float | None:
        """Time constant of the slow part of the noise in s; None estimates it."""
        ...

    @property
    def huber(self) -> float | None:
        """Threshold on the innovations in their deviations; None is least squares."""
        ...


@dataclass(frozen=True)
class NoiseChoice:
    """Given and estimated parts of the noise model."""

    slow: bool
    """The noise has a slow part."""
    time: float | None = None
    """Time constant of the slow part in s; None estimates it."""
    huber: float | None = None
    """Threshold on the innovations, in their deviations, beyond which their cost grows in
    proportion to them; None is least squares."""

    @classmethod
    def of(cls, method: NoiseSettings) -> NoiseChoice | None:
        """Take the choice from a method; None where the method is plain least squares."""
        slow = method.noise_model == "slow"
        if not slow and method.huber is None:
            return None
        return cls(slow, method.slow_time, method.huber)


def check_noise(method: NoiseSettings) -> None:
    """Check the noise settings of a method.

    Raises:
        UserError: if a setting is out of its range.
    """
    check_choice(method, "noise_model", get_args(NoiseKind))
    for name in ("slow_time", "huber"):
        value = getattr(method, name)
        demand(method, name, value is None or value > 0, "None or a positive number")
    if method.slow_time is not None and method.noise_model != "slow":
        raise UserError(
            f"{owner(method)}: slow_time is the time constant of a slow disturbance; set "
            'noise_model to "slow" with it, or leave it out'
        )


def refuse_noise(method: NoiseSettings, place: str) -> None:
    """Refuse a noise model where a family cannot use one.

    Args:
        method: method with the settings.
        place: family with its settings, for the message.

    Raises:
        UserError: if a noise model is configured.
    """
    if NoiseChoice.of(method) is not None:
        raise UserError(
            f"{place}: cannot weigh errors by a noise model; leave noise_model, slow_time and "
            f"huber out of {owner(method)}"
        )
