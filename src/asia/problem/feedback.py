"""Feedback loop of the records: the measured reference and, where it is known, the controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator

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
        BeforeValidator(lambda value: (value,) if isinstance(value, str) else tuple(value)),
        AfterValidator(_filled),
    ]
    """Measured references; columns of the records that are no inputs."""
    enters: Literal["controller", "plant"] = "controller"
    """"controller": u = C (r - y). "plant": u = r - C y, an excitation added to the input."""
    controller: Controller | None = None
    """None where it is unknown."""
    inputs: Literal["measured", "explained"] = "measured"
    """"explained" replaces the inputs of the training records by the part that the reference
    explains, which is free of noise: the two-stage method for every family, and for V."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Settings `loop` of the family `linear` that apply, a known controller first; none where
        the feedback of noise is already out of the inputs."""
        if self.inputs == "explained":
            return ()
        return (*(("controller",) if self.controller else ()), "direct", "two_stage")

    def check(self, inputs: int, outputs: int) -> None:
        """Raise UserError where the loop does not fit the numbers of signals."""
        expected = outputs if self.enters == "controller" else inputs
        if len(self.reference) != expected:
            raise UserError(
                f"[loop] reference: has {len(self.reference)} signals, expected {expected}: one "
                f"for each {'output' if self.enters == 'controller' else 'input'}, as "
                f"enters = '{self.enters}'"
            )
        if self.controller is not None:
            shape = self.controller.matrices[3].shape
            if shape != (inputs, outputs):
                raise UserError(
                    f"[loop] controller: has {shape[1]} errors and {shape[0]} outputs, expected "
                    f"{outputs} and {inputs}: those of the plant"
                )


def _rows(matrix: Sequence[Any] | Array) -> Matrix:
    return tuple(tuple(row) for row in np.asarray(matrix, dtype=np.float64).tolist())


def loop_table(loop: Loop | None) -> dict[str, Any] | None:
    """[loop] of problem.toml; None without a loop."""
    if loop is None:
        return None
    found: dict[str, Any] = {
        "reference": [asdict(signal) for signal in loop.reference],
        "enters": loop.enters,
        "inputs": loop.inputs,
    }
    if loop.controller is not None:
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
    known = "known" if loop.controller else "unknown"
    lines = [f"loop: reference {names} enters at {where}; controller {known}"]
    if loop.inputs == "explained":
        return [
            *lines,
            "loop: inputs = 'explained': every family is fitted and scored with the part of the "
            "inputs that the reference explains, which is free of noise. For a plant that "
            "integrates or is unstable take inputs = 'measured' and linear with loop='direct'",
        ]
    method, reason = "direct", "a predictor with a noise model needs no controller"
    if loop.controller is not None:
        method = "controller"
        reason = (
            "the loop can be simulated from the reference, and noise of any colour leaves the "
            "plant without bias. The controller must be linear and never saturate"
        )
    lines += [
        f"loop: the reference explains {_explained_share(records):.0%} of the variance of the "
        "inputs, feedback of noise and disturbances the rest",
        f"loop: take linear with loop='{method}': {reason}",
        "loop: V simulates from the measured input, and noise that the controller feeds back "
        "favours biased plants: a search tries only linear models by this method, and given "
        "equations. For a stable plant inputs = 'explained' in [loop] opens all families",
    ]
    if whole:
        lines.append(
            "loop: V simulates whole records from the measured input. For a plant that integrates "
            "or is unstable score windows instead: kind = 'windows' in [protocol]"
        )
    return lines


def explained_inputs(records: Sequence[Trajectory]) -> list[Array]:
    """Return the part (T, nu) of the inputs of each record that lags of the references explain,
    by one regression over all records; before a record the reference is held."""
    lags, columns = max(20, min(200, min(len(r) for r in records) // 12)), list[Array]()
    for record in records:
        assert record.reference is not None
        held = np.repeat(record.reference[:1], lags, axis=0)
        r = np.concatenate([held, record.reference])
        columns.append(np.hstack([r[lags - k : len(r) - k] for k in range(lags + 1)]))
    x, u = np.concatenate(columns), np.concatenate([r.u for r in records])
    gains = np.linalg.lstsq(x - x.mean(axis=0), u - u.mean(axis=0), rcond=1e-8)[0]
    return [(one - x.mean(axis=0)) @ gains + u.mean(axis=0) for one in columns]


def _explained_share(records: Sequence[Trajectory]) -> float:
    """Share of the variance of the inputs that the references explain, from 0 to 1."""
    u, explained = (
        np.concatenate(parts) for parts in ([r.u for r in records], explained_inputs(records))
    )
    total = ((u - u.mean(axis=0)) ** 2).sum()
    return float(1.0 - ((u - explained) ** 2).sum() / max(total, 1e-300))
