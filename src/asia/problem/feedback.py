"""Feedback loop of the records: the measured reference and, where it is known, the controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from asia._plugins import load_target
from asia.data.trajectory import Array, Signal
from asia.errors import UserError

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Controller:
    """Discrete controller u = C e: as a transfer function in z, or as a state-space model."""

    numerator: tuple[float, ...] = ()
    """Coefficients of descending powers of z."""
    denominator: tuple[float, ...] = ()
    a: Matrix = ()
    b: Matrix = ()
    c: Matrix = ()
    d: Matrix = ()

    def __post_init__(self) -> None:
        if bool(self.numerator) == bool(self.d) or bool(self.numerator) != bool(self.denominator):
            raise ValueError(
                "is no controller: give numerator and denominator, or the matrices a, b, c and d"
            )
        if self.numerator and len(self.numerator) > len(self.denominator):
            raise ValueError(
                "has a numerator of higher degree than the denominator: the controller would need "
                "future errors"
            )
        if self.numerator and self.denominator[0] == 0:
            raise ValueError("has a denominator that begins with 0: leave the leading zeros out")

    @property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C and D."""
        if not self.numerator:
            d = np.array(self.d, dtype=np.float64)
            n = len(self.a)
            shapes = ((n, n), (n, d.shape[1]), (d.shape[0], n))
            parts = zip((self.a, self.b, self.c), shapes, strict=True)
            a, b, c = (np.array(m, np.float64).reshape(shape) for m, shape in parts)
            return a, b, c, d
        den = np.array(self.denominator) / self.denominator[0]
        num = np.array(self.numerator) / self.denominator[0]
        num, n = np.concatenate([np.zeros(len(den) - len(num)), num]), len(den) - 1
        a = np.eye(n, k=-1)
        a[:1] = -den[1:]
        c = (num[1:] - num[0] * den[1:])[None]
        return a, np.eye(n, 1), c, num[:1, None]

    def delayed(self, samples: int) -> Controller:
        """The same controller with its output delayed."""
        a, b, c, d = self.matrices
        for _ in range(samples):
            n, nu = len(a), len(d)
            a = np.block([[a, np.zeros((n, nu))], [c, np.zeros((nu, nu))]])
            b, c = np.vstack([b, d]), np.hstack([np.zeros((nu, n)), np.eye(nu)])
            d = np.zeros_like(d)
        return Controller(a=_rows(a), b=_rows(b), c=_rows(c), d=_rows(d))


def _named(value: Any) -> Any:
    values = [value] if isinstance(value, str) else value
    return [{"name": v} if isinstance(v, str) else v for v in values]


def _filled(signals: tuple[Signal, ...]) -> tuple[Signal, ...]:
    if not signals or any(not s.name for s in signals):
        raise ValueError("names no signal: give the column of the measured reference")
    return signals


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Feedback loop in which the records were taken."""

    reference: Annotated[tuple[Signal, ...], BeforeValidator(_named), AfterValidator(_filled)]
    """Measured references; columns of the records that are no inputs."""
    enters: Literal["controller", "plant"] = "controller"
    """"controller": u = C (r - y). "plant": u = r - C y, an excitation added to the input."""
    controller: Annotated[Controller | str | None, Field(union_mode="left_to_right")] = None
    """Controller, or `module:function` that returns it; None where it is unknown."""

    def resolved(self, inputs: int, outputs: int, sampling_time: float) -> Loop:
        """The loop with a controller of numbers.

        Raises:
            UserError: for a function that returns no controller, and for one that does not fit the
                signals.
        """
        controller, where = self.controller, "[loop] controller"
        if isinstance(controller, str):
            where = f"[loop] controller '{controller}'"
            found = load_target(controller, "[loop] controller")
            try:
                made = found() if callable(found) else found
            except Exception as error:
                raise UserError(f"{where}: raised {type(error).__name__}: {error}") from error
            controller = _controller(made, where, sampling_time)
        expected = outputs if self.enters == "controller" else inputs
        if len(self.reference) != expected:
            raise UserError(
                f"[loop] reference: has {len(self.reference)} signals, expected {expected}: one "
                f"for each {'output' if self.enters == 'controller' else 'input'}, as "
                f"enters = '{self.enters}'"
            )
        if controller is not None:
            shape = controller.matrices[3].shape
            if shape != (inputs, outputs):
                raise UserError(
                    f"{where}: has {shape[1]} errors and {shape[0]} outputs, expected {outputs} "
                    f"and {inputs}: those of the plant"
                )
        return Loop(reference=self.reference, enters=self.enters, controller=controller)


def _controller(made: Any, where: str, sampling_time: float) -> Controller:
    """Controller from coefficients, matrices, or a system of python-control or SciPy."""
    step = getattr(made, "dt", None)
    if step is not None and step is not True and abs(step - sampling_time) > 1e-6 * sampling_time:
        raise UserError(
            f"{where}: has the sampling time {step} s, expected {sampling_time:g} s: that of the "
            "records"
        )
    if all(hasattr(made, name) for name in "ABCD"):
        made = tuple(getattr(made, name) for name in "ABCD")
    elif hasattr(made, "num") and hasattr(made, "den"):
        made = made.num, made.den
    try:
        parts = [np.asarray(part, dtype=np.float64) for part in made]
        if len(parts) == 2:
            num, den = (tuple(np.ravel(part).tolist()) for part in parts)
            return Controller(num, den)
        a, b, c, d = (_rows(np.atleast_2d(part)) for part in parts)
        return Controller(a=a, b=b, c=c, d=d)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{where}: returned no discrete controller ({error}); expected (numerator, "
            "denominator), (A, B, C, D), or a system of python-control or SciPy"
        ) from error


def _rows(matrix: Sequence[Any] | Array) -> Matrix:
    return tuple(tuple(row) for row in np.asarray(matrix, dtype=np.float64).tolist())


def loop_table(loop: Loop | None) -> dict[str, Any] | None:
    """[loop] of problem.toml; None without a loop."""
    if loop is None:
        return None
    found: dict[str, Any] = {
        "reference": [asdict(signal) for signal in loop.reference],
        "enters": loop.enters,
    }
    if isinstance(loop.controller, Controller):
        found["controller"] = {k: v for k, v in asdict(loop.controller).items() if v}
    return found
