"""Conformance suite of validation checks."""

from collections.abc import Sequence

import numpy as np

from asia.data.segment import Segment
from asia.data.trajectory import Array
from asia.judge.scoring.checks.check import Cause, Check, Verdict
from asia.judge.scoring.checks.response import HORIZONS, impulse_response
from asia.judge.scoring.checks.validation_data import (
    LinearResponse,
    SimulatedSegments,
    ValidationCheck,
    ValidationData,
)


def check_validation_check(check: ValidationCheck) -> None:
    """Apply the check to models of made-up systems: a sound model and seven with a known defect.

    Checked: each result has a name of its own and a sentence of one line; a cause and a weight come
    only with DOUBT or FAIL; curves are finite and as long as their axis; the same data give the
    same result; the data stay unchanged; short records, several outputs and missing measurements
    raise nothing; a sound model does not FAIL; at least one of the defects changes the result.
    Raises AssertionError that says what fails, and whatever the check raises.
    """

    def results(checks: Sequence[Check]) -> list[tuple[Verdict, str]]:
        return [(c.verdict, c.sentence) for c in checks]

    sound = _applied(check, "a sound model", _data())
    again = _applied(check, "a sound model", _data())
    assert results(sound) == results(again), "the same data give another result"
    failed = [c.name for c in sound if c.verdict is Verdict.FAIL]
    assert not failed, f"a sound model fails: {', '.join(failed)}"
    defects = ("gain", "delay", "saturation", "drift", "friction", "bias", "unstable")
    found = [_applied(check, f"a model with the defect {d}", _data(d)) for d in defects]
    same = all(results(one) == results(sound) for one in found)
    assert not same, f"none of the defects {', '.join(defects)} changes the result"
    _applied(check, "records of 40 samples", _data(samples=40))
    _applied(check, "two outputs", _data(outputs=2))
    _applied(check, "records with missing measurements", _data(missing=True))


def _applied(check: ValidationCheck, data_name: str, data: ValidationData) -> tuple[Check, ...]:
    before = [a.copy() for a in _arrays(data)]
    found = check(data)
    results = found if isinstance(found, tuple) else (found,)
    for one in results:
        _check_result(one, data_name)
    names = [one.name for one in results]
    assert len(set(names)) == len(names), f"{data_name}: a name is used twice: {names}"
    pairs = zip(before, _arrays(data), strict=True)
    unchanged = all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    assert unchanged, f"{data_name}: the arrays were changed"
    return results


def _check_result(one: object, data_name: str) -> None:
    assert isinstance(one, Check), f"{data_name}: the result is {one!r}, expected a Check"
    where = f"{data_name}: check {one.name!r}"
    assert one.name.strip() == one.name != "", f"{where}: a name is a few words"
    assert isinstance(one.verdict, Verdict), f"{where}: {one.verdict!r} is no Verdict"
    assert len(one.sentence.splitlines()) == 1, f"{where}: expected a sentence of one line"
    assert one.cause is None or isinstance(one.cause, Cause), f"{where}: {one.cause!r} is no Cause"
    judged = one.verdict in (Verdict.DOUBT, Verdict.FAIL)
    assert judged or (one.cause is None and one.weight == 0.0), (
        f"{where}: a cause or a weight with verdict {one.verdict}"
    )
    assert 0.0 <= one.weight < np.inf, f"{where}: weight {one.weight}"
    for curve in one.curves:
        shapes = np.shape(curve.x), np.shape(curve.y)
        assert [len(curve.x)] == [*shapes[0]] == [*shapes[1]], (
            f"{where}: curve {curve.name!r} has shapes {shapes}, expected two of (n,)"
        )
        finite = np.isfinite(curve.x).all() and np.isfinite(curve.y).all()
        assert finite, f"{where}: curve {curve.name!r} is not finite"


def _arrays(data: ValidationData) -> list[Array]:
    blocks = [a for b in data.simulations.blocks for a in (b.u, b.y, b.y_hat)]
    return [*blocks, *(r.impulse for r in data.linear_responses), data.lowest, data.highest]


def _simulated(u: Array, a: tuple[float, float] = (1.3, -0.5)) -> Array:
    """Second-order system with static gain 1.5."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        before = u[k - 2] if k > 1 else 0.0
        y[k] = a[0] * y[k - 1] + 0.2 * u[k - 1] + 0.1 * before + (a[1] * y[k - 2] if k > 1 else 0.0)
    return y


def _data(
    defect: str = "", *, samples: int = 720, outputs: int = 1, missing: bool = False
) -> ValidationData:
    """Data of a model that lacks what the system has."""
    random = np.random.default_rng(3)
    u = np.repeat(random.uniform(-1.0, 1.0, samples // 8), 8) + 0.2 * random.normal(size=samples)
    y_hat = _simulated(u)
    true = {
        "gain": lambda y: -y,
        "delay": lambda y: np.concatenate([np.zeros(4), y[:-4]]),
        "saturation": lambda y: np.minimum(y, 0.3),
        "drift": lambda y: y + np.linspace(0.0, 1.2, len(y)),
        "friction": lambda y: y - 0.3 * np.sign(np.gradient(y)),
        "bias": lambda y: y + 1.0,
    }.get(defect, lambda y: y)(y_hat)
    measured = true[:, None] + 0.02 * random.normal(size=(samples, outputs))
    simulated = np.tile(y_hat[:, None], (1, outputs))
    lowest, highest = measured.min(axis=0), measured.max(axis=0)
    if missing:
        measured[samples // 4 : samples // 3, 0] = np.nan
        measured[::7, 0] = np.nan
    parts = [np.array_split(x, 3) for x in (u[:, None], measured, simulated)]
    starts = np.cumsum([0, *(len(p) for p in parts[0])]).tolist()
    blocks = tuple(
        Segment(u[:0], y[:0], u, y, start=start).simulated(y_hat)
        for u, y, y_hat, start in zip(*parts, starts[:3], strict=True)
    )
    names = tuple(f"output {k}" for k in range(1, outputs + 1))

    def long_run() -> Array | None:
        if defect == "unstable":
            return None
        return np.tile(_simulated(np.tile(u, HORIZONS))[:, None], (1, outputs))

    size = -1e-3 if defect == "gain" else 1e-3
    up = np.tile(_simulated(np.full(300, size))[:, None], (1, outputs))
    response = LinearResponse("middle inputs", "input", impulse_response(up, -up, 1e-3))
    return ValidationData(
        simulations=SimulatedSegments(blocks, ("input",), names, 0.5),
        linear_responses=() if defect == "unstable" else (response,),
        lowest=lowest,
        highest=highest,
        noise=lambda: [0.02 / float(s) for s in np.nanstd(measured, axis=0)],
        long_run=long_run,
    )
