"""Search for certificates of a lowered model: stability, gains, tubes and invariant boxes.

A statement is kept only if the independent check proves it. Sources: Boyd et al., Linear Matrix
Inequalities in System and Control Theory, 1994 (bounded real lemma); Blanchini and Miani,
Set-Theoretic Methods in Control, 2008 (invariant sets, peak gain).
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from asia.control.certificate_check import (
    FORMAT,
    digest,
    forever,
    prove,
    returning,
    sentence,
    transformed,
)
from asia.data.trajectory import Array
from asia.lowering.derivatives import derivatives
from asia.lowering.enclosure import UnboundedError, affine_matrices, interval, reach
from asia.lowering.evaluation import evaluate
from asia.lowering.linear import joined, split
from asia.lowering.program import LoweredModel
from asia.lowering.wire import pack

_SLACK = 1e-6
_RETURNS = (1, 4, 16, 64, 200)
_ROUNDS = 10
_WALK = 1_000
_LARGEST_GROWTH = 30.0
_MOST_STATES = 200
# Waiting times in samples that are tried before limits for all times begin.
_SETTLINGS = (0, 25, 50, 100, 200, 400, 800)
# Share of its size in which each state is moved beside the inputs.
_FLOOR = 1e-3
# Operations of affine steps.
_ARITHMETIC = frozenset((
    "reshape", "broadcast", "transpose", "slice", "pick", "concat", "pad", "add", "sub", "mul",
    "neg", "matmul", "rsum", "max", "min",
))  # fmt: skip
# Simulations that look for an input sequence which leaves the limits.
_RUNS = 10


def certify(
    model: LoweredModel, u: Array, start: Array, horizon: int, facts: dict[str, Any],
    y: Array | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Find and prove statements on a model.

    Args:
        model: lowered model
        u: least and largest input, (nu, 2)
        start: state (n,) or box of states (2, n) in which the tube begins
        horizon: samples of the tube
        facts: further entries of the certificate: `assumptions`, `inputs`, `outputs`
        y: limits of the outputs (ny, 2) to prove, infinite for none

    Returns:
        the certificate, with `missed`: what has none, a sentence each
    """
    box = np.stack([start, start]) if start.ndim == 1 else start
    found: list[dict[str, Any]] = []
    missed: list[str] = []

    def keep(one: dict[str, Any]) -> bool:
        """Keep a statement if the check proves it."""
        try:
            holds = prove(model, u, one)
        except UnboundedError:
            holds = False
        if holds:
            found.append({**one, "text": sentence(one, facts)})
        return holds

    linear = _linear_statements(model)
    if isinstance(linear, str):
        missed.append(f"no certificate of stability and gains: {linear}")
    else:
        for one in linear:
            if not keep(one):
                missed.append(f"no certificate of {one['kind']}")
    tube = _narrowest_tube(model, u, box, horizon)
    if isinstance(tube, str):
        missed.append(f"no certificate of a tube over {horizon} samples: {tube}")
    elif not keep(tube):
        missed.append("no certificate of a tube")
    invariant = _invariant_box(model, u, box)
    if invariant is None or not keep(invariant):
        missed.append("no certificate for all times: no box of states was found that is not left")
    limits = None if invariant is None else _limits(model, u, box, invariant)
    if limits is not None:
        keep(limits)
    if y is not None:
        sides = [[v if np.isfinite(v) else None for v in side] for side in y.T.tolist()]
        wanted = {"kind": "output limits", "lower": sides[0], "upper": sides[1]}
        always = limits is not None and keep({**limits, **wanted})
        now = {**wanted, "always": False, "samples": horizon, "start": box.tolist(),
               "chord": not isinstance(tube, str) and tube["chord"]}  # fmt: skip
        if not always and not keep(now):
            missed.append(_why_not_within(model, u, box, y, horizon, facts))
    content: dict[str, Any] = {
        "format": FORMAT,
        **facts,
        "u": u.tolist(),
        "statements": found,
        "missed": missed,
        "program": base64.b64encode(pack(model)).decode(),
    }
    return {**content, "sha256": digest(content)}


def _narrowest_tube(
    model: LoweredModel, u: Array, box: Array, horizon: int
) -> dict[str, Any] | str:
    """Tube by the slopes of chords or by mean slopes, or why there is none."""
    found: list[dict[str, Any]] = []
    reason = ""
    for chord in _slope_choices(model):
        try:
            low, high, _ = reach(model, interval(*box), (u[:, 0], u[:, 1]), horizon, chord=chord)
        except UnboundedError as error:
            reason = reason or str(error)
            continue
        wide = _SLACK * (high - low) + 1e-12 * (1.0 + np.abs(low) + np.abs(high))
        found.append({"kind": "tube", "chord": chord, "start": box.tolist(),
                      "lower": (low - wide).tolist(), "upper": (high + wide).tolist()})  # fmt: skip

    def width(one: dict[str, Any]) -> float:
        return float((np.array(one["upper"]) - np.array(one["lower"])).sum())

    return min(found, key=width) if found else reason


def _slope_choices(model: LoweredModel) -> tuple[bool, ...]:
    """Whether functions are replaced by the slopes of chords: both where there are functions."""
    has_functions = any(node.op not in _ARITHMETIC for node in model.step.plain.nodes)
    return (False, True) if has_functions else (False,)


def _linear_statements(model: LoweredModel) -> list[dict[str, Any]] | str:
    """Candidates for stability and gains, or why there are none."""
    from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

    try:
        a, b, c, d = (one.c for one in affine_matrices(model))
    except UnboundedError as error:
        return str(error)
    n = len(a)
    if n > _MOST_STATES:
        return f"more than {_MOST_STATES} states"
    largest = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))
    if largest >= 1.0 - 1e-9:
        return f"the linear model has a pole of size {largest:.6g}"
    p = _symmetric(solve_discrete_lyapunov(a.T, np.eye(n)))
    found: list[dict[str, Any]] = [{"kind": "stability", "P": p.tolist()}]
    z = np.exp(1j * np.concatenate([[0.0], np.geomspace(1e-6, np.pi, 2000)]))[:, None, None]
    rise = np.abs(d + c @ np.linalg.solve(z * np.eye(n) - a, b + 0j)).max(axis=0)
    decay = largest + 0.5 * (1.0 - largest)
    q = _symmetric(solve_discrete_lyapunov((a / decay).T, np.eye(n)))
    terms = int(min(max(np.log(1e-7) / np.log(max(decay, 1e-9)), 20), 20_000))
    for i in range(model.ny):
        for j in range(model.nu):
            here, x = float(abs(d[i, j])), b[:, j]
            for _ in range(terms):
                here += float(abs(c[i] @ x))
                x = a @ x
            distance = float(np.sqrt(c[i] @ np.linalg.solve(q, c[i]))) * (1 + 1e-6) + 1e-12
            here += distance * float(np.sqrt(max(x @ q @ x, 0.0))) / (1 - decay)
            found.append({
                "kind": "peak gain", "output": i, "input": j, "bound": here * (1 + 1e-6) + 1e-9,
                "decay": decay, "P": q.tolist(), "terms": terms, "reach": distance,
            })  # fmt: skip
            lower = float(rise[i, j])
            row, column = c[i : i + 1], b[:, j : j + 1]
            for margin in (1e-4, 1e-3, 1e-2, 0.1):
                bound = lower * (1 + margin) + 1e-9
                shift = (
                    0.1
                    * margin
                    * bound**2
                    * np.eye(n)
                    / (1 + float(np.trace(p @ column @ column.T)))
                )
                try:
                    riccati = -solve_discrete_are(
                        a, column, -(row.T @ row) - shift,
                        np.array([[bound**2 - d[i, j] ** 2]]), s=-row.T * d[i, j],
                    )  # fmt: skip
                except (np.linalg.LinAlgError, ValueError):
                    continue
                one = {"kind": "H-infinity norm", "output": i, "input": j, "bound": bound,
                       "lower": lower, "P": _symmetric(riccati).tolist()}  # fmt: skip
                try:
                    if prove(model, np.zeros((model.nu, 2)), one):
                        break
                except UnboundedError:
                    continue
            else:
                one = {"kind": "H-infinity norm", "output": i, "input": j, "bound": 0.0,
                       "P": p.tolist()}  # fmt: skip
            found.append(one)
    return found


def _symmetric(matrix: Any) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T), np.float64)


def _why_not_within(
    model: LoweredModel, u: Array, box: Array, y: Array, horizon: int, facts: dict[str, Any]
) -> str:
    """A simulation that leaves the limits of the outputs, or where the enclosure does."""
    names = [str(name) for name, _ in facts.get("outputs", ())]

    def first(low: Array, high: Array) -> str | None:
        """Earliest sample (H, ny) outside, with its output and value."""
        below, above = low < y[:, 0], high > y[:, 1]
        if not (below | above).any():
            return None
        k, i = (int(v) for v in np.argwhere(below | above)[0])
        value = low[k, i] if below[k, i] else high[k, i]
        name = names[i] if names else f"output {i + 1}"
        return f"{name} is {value:.6g} at sample {k + 1}"

    rng = np.random.default_rng(0)
    for hold in np.repeat((horizon, max(horizon // 4, 1), 3), (min(2**model.nu, 16), _RUNS, _RUNS)):
        x, outputs = box[int(rng.integers(0, 2))], np.empty((horizon, model.ny))
        share = rng.integers(0, 2, (horizon // int(hold) + 1, model.nu))
        for k in range(horizon):
            inputs = u[:, 0] + (u[:, 1] - u[:, 0]) * share[k // int(hold)]
            outputs[k], *after = evaluate(model.step, [*split(model, x), inputs])
            x = joined(after)
        found = first(outputs, outputs)
        if found is not None:
            return f"the limits of the outputs do not hold: in a simulation {found}"
    try:
        low, high, _ = reach(model, interval(*box), (u[:, 0], u[:, 1]), horizon)
    except UnboundedError as error:
        return f"no certificate of the limits of the outputs: {error}"
    return (
        f"no certificate of the limits of the outputs: in the enclosure {first(low, high)}, in no "
        "simulation"
    )


def _invariant_box(model: LoweredModel, u: Array, start: Array) -> dict[str, Any] | None:
    """Fixed-point iteration: a box grows by what can be reached from it after some samples. Its
    axes are those of the states, else those of the ellipsoid that the linearised model reaches."""
    rng = np.random.default_rng(0)
    x = 0.5 * (start[0] + start[1])
    visited = [start[0], start[1]]
    share = np.zeros(model.nu)
    for k in range(_WALK):
        # Inputs at their limits for a long time, then changing fast.
        if k < _WALK // 2 and k % (_WALK // 8) == 0:
            share = (
                share
                if k == 0
                else 1.0 - share
                if k % (_WALK // 4)
                else rng.integers(0, 2, model.nu)
            )
        elif k >= _WALK // 2 and rng.random() < 0.2:
            share = rng.integers(0, 2, model.nu)
        inputs = u[:, 0] + (u[:, 1] - u[:, 0]) * share
        x = joined(evaluate(model.update, [*split(model, x), inputs]))
        if not np.isfinite(x).all():
            return None
        visited.append(x)
    states = np.stack(visited)
    bases: list[Array | None] = [None]
    if 0 < len(x) <= _MOST_STATES:
        bases.append(_reached_axes(model, u, states.mean(axis=0)))
    tried = (
        _grown(model, u, states, basis, chord=chord)
        for k, basis in enumerate(bases)
        if basis is not None or not k
        for chord in _slope_choices(model)
    )
    return next((found for found in tried if found is not None), None)


def _grown(
    model: LoweredModel, u: Array, states: Array, basis: Array | None, *, chord: bool
) -> dict[str, Any] | None:
    z = states if basis is None else np.linalg.solve(basis, states.T).T
    low, high = z.min(axis=0), z.max(axis=0)
    back = None if basis is None else np.asarray(np.linalg.inv(basis), np.float64)
    for samples in _RETURNS:
        box = np.stack([low, high])
        for k in range(_ROUNDS):
            if ((box[1] - box[0]) > _LARGEST_GROWTH * (high - low) + 1e-6).any():
                break
            wide = 0.01 * 1.5**k * (box[1] - box[0]) + 1e-9
            box = np.stack([box[0] - wide, box[1] + wide])
            try:
                lower, upper, after, inside = returning(model, u, box, basis, samples, chord=chord)
            except UnboundedError:
                break
            if inside:
                found = {"kind": "invariant box", "samples": samples, "chord": chord,
                         "start": box.tolist(), "lower": lower.min(axis=0).tolist(),
                         "upper": upper.max(axis=0).tolist()}  # fmt: skip
                return found if basis is None else {**found, "basis": basis.tolist()}
            if back is not None:
                after = transformed(back, after)
            box = np.stack([np.minimum(box[0], after.low), np.maximum(box[1], after.high)])
    return None


def _slopes(model: LoweredModel, x: Array, inputs: Array) -> tuple[Array, Array]:
    """A and B of the states at a point."""
    _, slope = derivatives(model.update, [*split(model, x), inputs])
    return slope[:, : len(x)], slope[:, len(x) :]


def _reached_axes(model: LoweredModel, u: Array, x: Array) -> Array | None:
    """Axes of the ellipsoid of states that inputs within their limits reach, a little enlarged:
    the Cholesky factor of a Gramian of A / decay. None for an unstable linearisation."""
    from scipy.linalg import solve_discrete_lyapunov

    a, b = _slopes(model, x, u.mean(axis=1))
    radius = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0)) if np.isfinite(a).all() else 1.0
    if not radius < 1.0 - 1e-9:
        return None
    decay = radius + 0.3 * (1.0 - radius)
    push = b * (0.5 * (u[:, 1] - u[:, 0]) + 1e-9)
    spread = push @ push.T
    size = np.diag(_symmetric(solve_discrete_lyapunov(a / decay, spread))).clip(0.0)
    floor = _FLOOR * (size + _FLOOR * max(float(size.max(initial=0.0)), 1e-12))
    gramian = _symmetric(solve_discrete_lyapunov(a / decay, spread + np.diag(floor)))
    try:
        return np.asarray(np.linalg.cholesky(gramian), np.float64)
    except np.linalg.LinAlgError:
        return None


def _limits(
    model: LoweredModel, u: Array, box: Array, invariant: dict[str, Any]
) -> dict[str, Any] | None:
    """Limits of the outputs from the start for all times, by a set that is not left: the longer
    it settles, the less of its width is left in the outputs."""
    samples = int(invariant["samples"])
    best: tuple[float, int, tuple[Array, Array]] | None = None
    for least in _SETTLINGS:
        settling = -(-least // samples) * samples
        try:
            found = forever(model, u, box, invariant, settling)
        except UnboundedError:
            break
        if found is None:
            break
        wide = float((found[1] - found[0]).sum())
        if best is not None and wide > 0.98 * best[0]:
            break
        best = wide, settling, found
    if best is None:
        return None
    _, settling, (low, high) = best
    slack = _SLACK * (high - low) + 1e-12 * (1.0 + np.abs(low) + np.abs(high))
    kept = {
        name: invariant[name]
        for name in ("start", "samples", "basis", "chord")
        if name in invariant
    }
    return {"kind": "limits", "always": True, "start": box.tolist(), "set": kept,
            "settling": settling, "samples": settling + samples,
            "lower": (low - slack).tolist(), "upper": (high + slack).tolist()}  # fmt: skip


def text_lines(content: dict[str, Any]) -> list[str]:
    """Lines of a certificate: statements, assumptions, and what has none."""
    return [
        *(f"proven    {one['text']}" for one in content["statements"]),
        *(f"open      {one}" for one in content["missed"]),
        *(f"assumes   {one}" for one in content["assumptions"]),
    ]
