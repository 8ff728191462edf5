"""Feedback loop of the records: the measured reference and, where it is known, the controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from asia._plugins import load_target
from asia.data.trajectory import Array, Signal, Trajectory
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


def _signal(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


def _filled(signals: tuple[Signal, ...]) -> tuple[Signal, ...]:
    if not signals or any(not s.name for s in signals):
        raise ValueError("names no signal: give the column of the measured reference")
    return signals


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Feedback loop in which the records were taken."""

    reference: Annotated[
        tuple[Annotated[Signal, BeforeValidator(_signal)], ...],
        BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
        AfterValidator(_filled),
    ]
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


def loop_lines(loop: Loop, records: Sequence[Trajectory], *, whole: bool) -> list[str]:
    """Describe the loop, and the method that applies with its reason.

    Args:
        loop: loop of the records.
        records: records with their references.
        whole: whole records are simulated for the score.
    """
    names = ", ".join(signal.name for signal in loop.reference)
    where = "the controller" if loop.enters == "controller" else "the input of the plant"
    share = _explained_share(records)
    known = "known" if loop.controller else "unknown"
    lines = [
        f"loop: reference {names} enters at {where}; controller {known}; the reference explains "
        f"{share:.0%} of the variance of the inputs, feedback of noise and disturbances the rest"
    ]
    if loop.controller is not None:
        method, reason = (
            "controller",
            "the controller is known, so that the loop can be simulated from the reference: noise "
            "of any colour leaves the plant without bias. The controller must be linear and never "
            "saturate",
        )
    else:
        method, reason = (
            "direct",
            "a predictor with a noise model needs no controller. Compare with loop='two_stage', "
            + (
                "which needs no right noise model"
                if share >= _USEFUL_SHARE
                else "with care: the reference moves the input little"
            ),
        )
    lines.append(f"loop: take linear with loop='{method}': {reason}")
    if whole:
        lines.append(
            "loop: V simulates whole records from the measured input. For a plant that integrates "
            "or is unstable score windows instead: kind = 'windows' in [protocol]"
        )
    return lines


# Lags of the reference whose sum explains the inputs, and the least useful share of variance.
_LAGS, _USEFUL_SHARE = 40, 0.3


def _explained_share(records: Sequence[Trajectory]) -> float:
    """Share of the variance of the inputs that lags of the references explain, from 0 to 1."""
    rows, targets = list[Array](), list[Array]()
    for record in records:
        r = record.reference
        if r is not None and len(r) > _LAGS:
            views = [r[_LAGS - k : len(r) - k] for k in range(_LAGS + 1)]
            rows.append(np.hstack(views))
            targets.append(record.u[_LAGS:])
    if not rows:
        return 0.0
    x, u = np.concatenate(rows), np.concatenate(targets)
    x, u = x - x.mean(axis=0), u - u.mean(axis=0)
    left = u - x @ np.linalg.lstsq(x, u, rcond=1e-8)[0]
    # Regressors explain some noise by chance.
    freedom = max(len(x) - x.shape[1], 1)
    share = 1.0 - (left**2).sum() / freedom / max((u**2).sum() / len(u), 1e-300)
    return float(np.clip(share, 0.0, 1.0))
