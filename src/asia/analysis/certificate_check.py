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
        sentences.append(sentence(one))
    return sentences


def sentence(statement: dict[str, Any]) -> str:
    """Sentence of a statement, made from what is proven."""
    kind, i, j = statement["kind"], statement.get("output", 0), statement.get("input", 0)
    pair = f"output {i + 1} by input {j + 1}"
    if kind == "stability":
        return "the linear model is asymptotically stable"
    if kind == "peak gain":
        return f"peak gain, {pair}: at most {statement['bound']:.6g}"
    if kind == "H-infinity norm":
        return f"H-infinity norm, {pair}: at most {statement['bound']:.6g}"
    low, high = (np.atleast_2d(np.array(statement[side])) for side in ("lower", "upper"))
    spans = ", ".join(
        f"output {k + 1} in {a:.6g} to {b:.6g}"
        for k, (a, b) in enumerate(zip(low.min(axis=0), high.max(axis=0), strict=True))
    )
    if kind == "tube":
        return f"from the start, for {len(low)} samples: {spans}"
    return f"from every state in the box, for all times: {spans}"


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
    "stability": _stability,
    "peak gain": _peak_gain,
    "H-infinity norm": _h_infinity,
}
