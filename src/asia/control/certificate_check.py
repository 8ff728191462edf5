"""Independent check of certificates: the operations of the model over sets, and nothing else.

Nothing here searches. Each statement is proven again from the model in the file, in arithmetic
that rounds outward. A matrix M is positive definite if V M V' is diagonally dominant for some V.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
        found, loops = content["sha256"], content.get("loops")
        parts = [_Part.of(one) for one in ([content] if loops is None else loops)]
    except (ValueError, TypeError, LookupError, AttributeError, FormatError) as error:
        raise UserError(f"{path} is no certificate: {error}") from None
    if content.get("format") != FORMAT:
        raise UserError(f"{path} is no certificate of this version")
    if found != digest(content):
        raise UserError(f"{path} was changed: its digest differs; run asia certify again")
    for part in parts:
        for k, one in enumerate(part.statements, 1):
            try:
                holds = prove(part.model, part.u, one)
            except (UnboundedError, ValueError, TypeError, LookupError):
                holds = False
            if not holds:
                raise UserError(f"{path}: statement {k} is not proven: {one.get('text')}")
    if loops is None:
        return [sentence(one, content) for one in parts[0].statements]
    return common_sentences(loops)


@dataclass(frozen=True)
class _Part:
    """Statements on one model."""

    model: LoweredModel
    statements: list[dict[str, Any]]
    u: Array

    @classmethod
    def of(cls, content: dict[str, Any]) -> _Part:
        model = unpack(base64.b64decode(content["program"]))
        if isinstance(model, str):
            raise ValueError(model)
        return cls(model, list(content["statements"]), np.array(content["u"], np.float64))


def common_sentences(loops: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences that hold for each of several models, made from what is proven for them: the
    largest bound and the widest limits. Each begins with the models that it is proven for. Limits
    for all times stand for tube and box of a model."""
    models = list(dict.fromkeys(str(one["model"]) for one in loops))
    found: dict[tuple[object, ...], list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for content in loops:
        kinds = {one["kind"] for one in content["statements"]}
        for one in content["statements"]:
            if "limits" in kinds and one["kind"] in ("tube", "invariant box"):
                continue
            parts = (one.get(name) for name in ("kind", "output", "input", "always"))
            found.setdefault((*parts, content.get("subject")), []).append((content, one))
    lines: list[str] = []
    for rows in found.values():
        names = [str(content["model"]) for content, _ in rows]
        content, first = rows[0]
        whole, each = dict(first), [one for _, one in rows]
        if "bound" in first:
            whole["bound"] = max(one["bound"] for one in each)
        for side, least in (("lower", True), ("upper", False)):
            if side in first:
                spans = [np.atleast_2d(np.array(one[side], float)) for one in each]
                ends = [s.min(axis=0) if least else s.max(axis=0) for s in spans]
                whole[side] = (np.min(ends, axis=0) if least else np.max(ends, axis=0)).tolist()
        if first["kind"] == "tube":
            whole["samples"] = min(len(one["lower"]) for one in each)
        is_all = names == models and len(models) > 1
        every = f"all {len(models)} models" if is_all else ", ".join(names)
        lines.append(f"{every}: {sentence(whole, content)}")
    return lines


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
        return f"{content.get('subject', 'the linear model')} is asymptotically stable"
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
    if kind == "limits":
        return f"from the start, for all times: {listed}"
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
    low, high, _ = reach(
        model, _box(one), (u[:, 0], u[:, 1]), len(lower), chord=bool(one.get("chord"))
    )
    return lower.shape == low.shape and bool((lower <= low).all() and (high <= upper).all())


def transformed(matrix: Array, x: Enclosure) -> Enclosure:
    """Enclosure of M x for a vector."""
    column = Enclosure(x.c[:, None], x.g[:, :, None], x.r[:, None])
    found = point(matrix, len(x.g)) @ column
    return Enclosure(found.c[:, 0], found.g[:, :, 0], found.r[:, 0])


def _coordinates(box: Enclosure, basis: Array | None) -> tuple[Enclosure, Array]:
    """States T z of all z in a box, and T; without a basis T is one."""
    turn = np.eye(len(box.c)) if basis is None else basis
    z = Enclosure(box.c, np.diag(box.r), np.zeros(len(box.c)))
    return transformed(turn, z), turn


def _is_inside(x: Enclosure, turn: Array, box: Array) -> bool:
    """Whether T^-1 x is certainly in a box (2, n). W = T^-1 (I + E) is inverted up to E."""
    inverse = np.asarray(np.linalg.inv(turn), np.float64)
    e = float((point(inverse) @ point(turn) - point(np.eye(len(turn)))).size.sum(axis=1).max())
    z = transformed(inverse, x)
    if not e < 0.1:
        return False
    off = 1.01 * e / (1.0 - e) * float(z.size.max())
    return bool((z.low - off >= box[0]).all() and (z.high + off <= box[1]).all())


def returning(
    model: LoweredModel, u: Array, box: Array, basis: Array | None, samples: int, *, chord: bool
) -> tuple[Array, Array, Enclosure, bool]:
    """Limits of the outputs from all states T z with z in a box (2, n), the states after some
    samples, and whether they are certainly back in that set."""
    start, turn = _coordinates(interval(box[0], box[1]), basis)
    low, high, after = reach(model, start, (u[:, 0], u[:, 1]), samples, chord=chord)
    return low, high, after, samples >= 1 and _is_inside(after, turn, box)


def _set(one: dict[str, Any]) -> tuple[Array, Array | None, int]:
    basis = one.get("basis")
    turn = None if basis is None else np.array(basis, np.float64)
    return np.array(one["start"], np.float64), turn, int(one["samples"])


def _invariant(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """The set comes back into itself after some samples, and the outputs stay in between."""
    low, high, _, back = returning(model, u, *_set(one), chord=bool(one.get("chord")))
    lower, upper = (np.array(one[name]) for name in ("lower", "upper"))
    return bool(back and (lower <= low).all() and (high <= upper).all())


def forever(
    model: LoweredModel, u: Array, start: Array, invariant: dict[str, Any], settling: int
) -> tuple[Array, Array] | None:
    """Limits of the outputs from a box of states, for all times; None without a proof.

    The box lies in a set that comes back into itself after s samples. After `settling` samples, a
    multiple of s, an output is one of those that the set gives so late; before, one of the tube.
    """
    box, turn, samples = _set(invariant)
    chord = bool(invariant.get("chord"))
    first = interval(start[0], start[1])
    known = np.eye(len(first.c)) if turn is None else turn
    if samples < 1 or settling % samples or not _is_inside(first, known, box):
        return None
    low, high, after, back = returning(model, u, box, turn, samples, chord=chord)
    bounds = u[:, 0], u[:, 1]
    if not back:
        return None
    if settling:
        # From the set: samples s to s + settling, of which the last s count.
        low, high, _ = reach(model, after, bounds, settling, chord=chord)
        low, high = low[-samples:], high[-samples:]
        early = reach(model, first, bounds, settling, chord=chord)[:2]
        low, high = np.vstack([low, early[0]]), np.vstack([high, early[1]])
    return low.min(axis=0), high.max(axis=0)


def _output_limits(model: LoweredModel, u: Array, one: dict[str, Any]) -> bool:
    """The outputs stay within limits, None for no limit; for all times by an invariant set."""
    lower, upper = (
        np.array([fill if v is None else v for v in one[side]], np.float64)
        for side, fill in (("lower", -np.inf), ("upper", np.inf))
    )
    start = np.array(one["start"], np.float64)
    if "set" in one:
        found = forever(model, u, start, one["set"], int(one["settling"]))
        return found is not None and bool((lower <= found[0]).all() and (found[1] <= upper).all())
    # Without a set apart the start itself must be one.
    low, high, _, back = returning(
        model, u, start, None, int(one["samples"]), chord=bool(one.get("chord"))
    )
    inside = (lower <= low).all() and (high <= upper).all() and one["samples"] >= 1
    return bool(inside and (back or not one["always"]))


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
    "limits": _output_limits,
    "stability": _stability,
    "peak gain": _peak_gain,
    "H-infinity norm": _h_infinity,
}
