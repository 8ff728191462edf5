"""Independent check of certificates: the operations of the model over sets, and nothing else.

Nothing here searches. Each statement is proven again from the model in the file, in arithmetic
that rounds outward. A matrix M is positive definite if V M V' is diagonally dominant for some V.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.lowering.enclosure import (
    Enclosure,
    UnboundedError,
    affine_matrices,
    interval,
    point,
    reach,
)
from asia.lowering.program import LoweredModel
from asia.lowering.wire import FormatError, unpack

FORMAT: Final = "asia-certificate-1"
LARGEST_BYTES: Final = 64_000_000


def digest(content: dict[str, Any]) -> str:
    """Digest of a certificate without its own entry."""
    rest = {name: value for name, value in content.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def check_certificate(path: Path) -> list[str]:
    """Prove all statements of a file again and return them as sentences.

    Raises:
        UserError: for a file that was changed, is no certificate, or states what is not proven
    """
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise ValueError("too large")
        content = json.loads(path.read_bytes())
        found, model = content["sha256"], unpack(base64.b64decode(content["program"]))
        statements, u = list(content["statements"]), np.array(content["u"], np.float64)
    except (ValueError, TypeError, LookupError, FormatError) as error:
        raise UserError(f"{path} is no certificate: {error}") from None
    if content.get("format") != FORMAT or isinstance(model, str):
        raise UserError(f"{path} is no certificate of this version")
    if found != digest(content):
        raise UserError(f"{path} was changed: its digest differs; run asia certify again")
    sentences: list[str] = []
    for k, one in enumerate(statements, 1):
        try:
            holds = prove(model, u, one)
        except (UnboundedError, ValueError, TypeError, LookupError):
            holds = False
        if not holds:
            raise UserError(f"{path}: statement {k} is not proven: {one.get('text')}")
        sentences.append(sentence(one, content))
    return sentences


def sentence(statement: dict[str, Any], content: dict[str, Any]) -> str:
    """Sentence of a statement, made from what is proven and the signals of the certificate:
    `inputs` and `outputs`, a name and a unit each."""
    kind = statement["kind"]

    def signal(side: str, k: int) -> tuple[str, str]:
        """Name, and unit with a blank before it."""
        if side not in content:
            return f"{side[:-1]} {k + 1}", ""
        name, unit = content[side][k]
        return str(name), f" {unit}" if unit else ""

    if kind == "stability":
        return "the linear model is asymptotically stable"
    if kind in ("peak gain", "H-infinity norm"):
        (y, above), (u, below) = (
            signal("outputs", statement["output"]), signal("inputs", statement["input"]),
        )  # fmt: skip
        unit = f"{above or ' 1'}/{below.strip() or '1'}" if above or below else ""
        return f"{kind} of {u} to {y}: at most {statement['bound']:.6g}{unit}"
    low, high = (np.atleast_2d(np.array(statement[side], float)) for side in ("lower", "upper"))
    spans: list[str] = []
    for k, (a, b) in enumerate(zip(low.min(axis=0), high.max(axis=0), strict=True)):
        name, unit = signal("outputs", k)
        if np.isfinite([a, b]).all():
            spans.append(f"{name} in {a:.6g} to {b:.6g}{unit}")
    listed, samples = ", ".join(spans), int(statement.get("samples", len(low)))
    if kind == "output limits":
        long = "for all times" if statement["always"] else f"for {samples} samples"
        return f"within the limits, from the start, {long}: {listed}"
    if kind == "tube":
        return f"from the start, for {samples} samples: {listed}"
    return f"from every state in the box, for all times: {listed}"


def prove(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """Whether a statement is proven. u: least and largest input (nu, 2)."""
    return _PROOFS[one["kind"]](model, u, one)


def is_positive_definite(matrix: Enclosure) -> bool:
    """Whether all symmetric matrices of a set are certainly positive definite."""
    if not len(matrix.c):
        return True
    try:
        lower = np.linalg.cholesky(0.5 * (matrix.c + matrix.c.T))
    except np.linalg.LinAlgError:
        return False
    v = point(np.linalg.inv(lower))
    found = v @ matrix @ v.transposed
    off = found.size - np.diag(np.diag(found.size))
    return bool((np.diag(found.low) > off.sum(axis=1) * (1 + 1e-9)).all())


def _box(one: dict[str, Any]) -> Enclosure:
    start = np.array(one["start"], np.float64)
    return interval(start[0], start[1])


def _tube(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    lower, upper = np.array(one["lower"]), np.array(one["upper"])
    low, high, _ = reach(model, _box(one), (u[:, 0], u[:, 1]), len(lower))
    return lower.shape == low.shape and bool((lower <= low).all() and (high <= upper).all())


def _invariant(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """The box comes back into itself after some samples, and the outputs stay in between."""
    low, high, after = reach(model, _box(one), (u[:, 0], u[:, 1]), int(one["samples"]))
    start, lower, upper = (np.array(one[name]) for name in ("start", "lower", "upper"))
    back = (after.low >= start[0]).all() and (after.high <= start[1]).all()
    return bool(back and one["samples"] >= 1 and (lower <= low).all() and (high <= upper).all())


def _output_limits(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """The outputs stay within limits, None for no limit; for all times if the box is invariant."""
    limits = [[fill if v is None else v for v in one[side]]
              for side, fill in (("lower", -np.inf), ("upper", np.inf))]  # fmt: skip
    low, high, after = reach(model, _box(one), (u[:, 0], u[:, 1]), int(one["samples"]))
    start = np.array(one["start"])
    back = (after.low >= start[0]).all() and (after.high <= start[1]).all()
    inside = (np.array(limits[0]) <= low).all() and (high <= np.array(limits[1])).all()
    return bool(inside and one["samples"] >= 1 and (back or not one["always"]))


def _stability(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    a, p = affine_matrices(model)[0], point(one["P"])
    square = p.c.shape == a.c.shape and bool((p.c == p.c.T).all())
    return square and is_positive_definite(p) and is_positive_definite(p - a.transposed @ p @ a)


def _peak_gain(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """Sum of the impulse response, and a tail by x' P x, which falls by `decay` in each sample."""
    a, b, c, d = affine_matrices(model)
    i, j, decay, p = one["output"], one["input"], one["decay"], point(one["P"])
    if not (0 < decay < 1 and (p.c == p.c.T).all() and p.c.shape == a.c.shape):
        return False
    falling = p * point(np.full(p.c.shape, decay)) * point(np.full(p.c.shape, decay))
    if not (is_positive_definite(p) and is_positive_definite(falling - a.transposed @ p @ a)):
        return False
    row, x = _cut(c, slice(i, i + 1), slice(None)), b.c[:, j : j + 1]
    total = float(_cut(d, slice(i, i + 1), slice(j, j + 1)).size[0, 0])

    def norm(of: Enclosure) -> float:
        """Upper bound of sqrt(x' P x)."""
        return float(np.sqrt(max(float((of.transposed @ p @ of).high[0, 0]), 0.0))) * (1 + 1e-12)

    # Each state is computed in double precision; its error falls by `decay` and gets a new part.
    error = norm(_cut(b, slice(None), slice(j, j + 1)) - point(x))
    for _ in range(one["terms"]):
        total += float((row @ point(x)).size[0, 0]) + one["reach"] * error
        error = (decay * error + norm(a @ point(x) - point(a.c @ x))) * (1 + 1e-12)
        x = a.c @ x
    # row x <= sqrt(row P^-1 row') sqrt(x' P x), where reach^2 bounds the first.
    bordered = np.block([[p.c, row.c.T], [row.c, np.array([[one["reach"] ** 2]])]])
    radius = np.block([[p.r, row.r.T], [row.r, np.array([[4e-16 * one["reach"] ** 2]])]])
    if not is_positive_definite(Enclosure(bordered, np.zeros((0, *bordered.shape)), radius)):
        return False
    tail = one["reach"] * (norm(point(x)) + error) / (1.0 - decay)
    return bool((total + tail) * (1 + 1e-9) <= one["bound"])


def _cut(x: Enclosure, rows: slice, columns: slice) -> Enclosure:
    c = x.c[rows, columns]
    return Enclosure(c, np.zeros((0, *c.shape)), x.r[rows, columns])


def _h_infinity(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """Bounded real lemma, and a Lyapunov matrix for stability."""
    a, b, c, d = affine_matrices(model)
    i, j, p = one["output"], one["input"], point(one["P"])
    row, column = _cut(c, slice(i, i + 1), slice(None)), _cut(b, slice(None), slice(j, j + 1))
    through = _cut(d, slice(i, i + 1), slice(j, j + 1))
    if p.c.shape != a.c.shape or not (p.c == p.c.T).all():
        return False
    limit = point([[one["bound"]]])
    corner = limit * limit - through.transposed @ through - column.transposed @ p @ column
    side = -(a.transposed @ p @ column + row.transposed @ through)
    block = p - a.transposed @ p @ a - row.transposed @ row
    whole = [
        np.block([[getattr(block, s), getattr(side, s)], [getattr(side, s).T, getattr(corner, s)]])
        for s in ("c", "r")
    ]
    matrix = Enclosure(whole[0], np.zeros((0, *whole[0].shape)), whole[1])
    return is_positive_definite(p) and is_positive_definite(matrix)


_PROOFS: dict[str, Callable[[LoweredModel, Array, dict[str, Any]], bool]] = {
    "tube": _tube,
    "invariant box": _invariant,
    "output limits": _output_limits,
    "stability": _stability,
    "peak gain": _peak_gain,
    "H-infinity norm": _h_infinity,
}
