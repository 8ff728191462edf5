"""Linear models at operating points: against python-control, against a known system, and from the
command line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.export.linear import LinearPoint, LinearRun, mode_bands
from asia.interfaces.cli.linear import _dynamics, _pole_lines
from asia.lowering.derivatives import derivatives
from asia.lowering.linear import (
    LinearModel,
    OperatingPoint,
    ProcessModel,
    continuous,
    joined,
    largest_gain,
    linearised,
    minimal,
    operating_points,
    process_model,
    reduced,
)
from asia.lowering.program import Builder, LoweredModel
from tests.unit.interfaces.cli.conftest import command_line


def random_system(seed: int) -> LinearModel:
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers(1, 7), rng.integers(1, 3), rng.integers(1, 3)
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.3, 0.95) / np.abs(np.linalg.eigvals(a)).max()
    b, c, d = rng.normal(size=(n, m)), rng.normal(size=(p, n)), rng.normal(size=(p, m))
    return LinearModel(a, b, c, d, 0.1, np.zeros(m), np.zeros(p))


@pytest.mark.parametrize("seed", range(8))
def test_poles_responses_and_the_bound_of_a_reduction_agree_with_python_control(seed: int) -> None:
    own = random_system(seed)
    other = control.ss(own.a, own.b, own.c, own.d, 0.1)
    difference = np.sort_complex(own.poles) - np.sort_complex(other.poles())
    assert np.abs(difference).max() < 1e-8
    frequencies = np.geomspace(0.01, 4.9, 40)
    held = other(np.exp(2j * np.pi * frequencies * 0.1), squeeze=False)
    assert np.abs(own.response(frequencies) - np.moveaxis(held, -1, 0)).max() < 1e-8
    _, steps = control.step_response(other, T=0.1 * np.arange(50), squeeze=False)
    assert np.abs(own.step_response(50) - np.moveaxis(steps, -1, 0)).max() < 1e-8
    assert np.allclose(own.gain, other.dcgain().reshape(own.gain.shape), atol=1e-8)
    grid = np.linspace(0.0, 5.0, 300)
    for order in range(own.order + 1):
        small = reduced(own, order)
        apart = small.model.response(grid) - own.response(grid)
        assert max(np.linalg.norm(one, 2) for one in apart) <= small.bound * (1 + 1e-6) + 1e-8


@pytest.mark.parametrize("seed", range(4))
def test_states_without_effect_are_left_out(seed: int) -> None:
    own = random_system(seed)
    rng = np.random.default_rng(seed)
    extra = np.diag(rng.uniform(-0.9, 0.9, 2))
    n = own.order
    turn = np.linalg.qr(rng.normal(size=(n + 2, n + 2)))[0]
    a = turn @ np.block([[own.a, np.zeros((n, 2))], [np.zeros((2, n)), extra]]) @ turn.T
    b = turn @ np.vstack([own.b, [[1.0] * own.b.shape[1], [0.0] * own.b.shape[1]]])
    c = np.hstack([own.c, np.zeros((len(own.c), 1)), np.ones((len(own.c), 1))]) @ turn.T
    found = minimal(LinearModel(a, b, c, own.d, 0.1, own.u0, own.y0))
    assert found.order == n
    assert np.abs(np.sort_complex(found.poles) - np.sort_complex(own.poles)).max() < 1e-8


def test_continuous_time_inverts_the_hold_and_names_the_dead_time() -> None:
    plant = control.ss([[-0.5, 1.0], [-1.0, -0.2]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    held = control.c2d(plant, 0.1)
    # Two samples of dead time as states.
    late = control.ss([[0, 0], [1, 0]], [[1], [0]], [[0, 1]], [[0]], 0.1)
    for extra, dead in ((held, 0), (held * late, 2)):
        one = LinearModel(extra.A, extra.B, extra.C, extra.D, 0.1, np.zeros(1), np.zeros(1))
        found, samples = continuous(minimal(one))
        assert samples == dead
        assert np.abs(np.sort_complex(found.poles) - np.sort_complex(plant.poles())).max() < 1e-8
        assert found.gain == pytest.approx(plant.dcgain())
    # The same plant with an input that is linear between samples.
    for extra, dead in ((control.c2d(plant, 0.1, method="foh"), 0), (None, 2)):
        made = control.c2d(plant, 0.1, method="foh") * late if extra is None else extra
        one = LinearModel(made.A, made.B, made.C, made.D, 0.1, np.zeros(1), np.zeros(1), ("first",))
        found, samples = continuous(minimal(one))
        assert samples == dead
        frequencies = np.geomspace(0.01, 3.0, 20)
        expected = plant(2j * np.pi * frequencies)
        assert found.response(frequencies)[:, 0, 0] == pytest.approx(expected, rel=1e-8)
        assert np.abs(found.d).max() < 1e-9
    swinging = LinearModel(
        np.array([[-0.5]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 0.1,
        np.zeros(1), np.zeros(1),
    )  # fmt: skip
    with pytest.raises(UserError, match="there is no continuous-time model"):
        continuous(swinging)


@given(
    st.sampled_from([(30.0,), (30.0, 8.0), (20.0, 20.0)]),
    st.sampled_from([0.0, 3.0]),
    st.booleans(),
)
def test_a_process_model_is_found_again(
    lags: tuple[float, ...], delay: float, integrator: bool
) -> None:
    true = ProcessModel(1.7, lags, 0.0, delay, integrator, 0.0)
    t = np.arange(0.0, 250.0, 0.5)
    found = process_model(t, true.step(t), integrator=integrator)
    assert found.fit > 99.5
    assert found.gain == pytest.approx(1.7, rel=0.02)
    assert len(found.lags) == len(lags)


def tank() -> LoweredModel:
    """x' = x + 0.1 (u - sqrt(x)), y = x: at rest x = u^2, dy/du = 2 u."""
    build = Builder(((1,), (1,)))
    outflow = build.add("sqrt", (0,))
    flow = build.add("sub", (1, outflow))
    after = build.add("add", (0, build.add("mul", (flow, build.constant(0.1)))))
    step = build.program([0, after])
    first = Builder(((1, 1), (1, 1), (1,)))
    initial = first.program([first.add("reshape", (1,), (1,))])
    return LoweredModel(1, 1, 1, 1, False, initial, step)


@pytest.mark.parametrize("u", [0.5, 1.0, 2.0])
def test_the_operating_point_of_a_tank_and_its_exact_slopes(u: float) -> None:
    model = tank()
    (point,) = operating_points(model, [np.array([3.0])], np.array([u]))
    assert point.y == pytest.approx([u * u], rel=1e-9)
    found = linearised(model, point, 1.0)
    assert found.gain[0, 0] == pytest.approx(2 * u, rel=1e-9)
    assert found.poles[0] == pytest.approx(1 - 0.05 / u, rel=1e-9)
    (asked,) = operating_points(model, [np.array([3.0])], np.ones(1), np.array([u * u]))
    assert asked.u == pytest.approx([u], rel=1e-6)


def test_bands_hold_all_fold_models_and_need_two_of_the_same_order() -> None:
    def lag(pole: float, gain: float) -> LinearModel:
        one = np.ones((1, 1))
        return LinearModel(pole * one, one, gain * (1 - pole) * one, 0 * one, 1.0, one[0], one[0])

    point = OperatingPoint(np.zeros(1), np.ones(1), np.ones(1), 0.0)
    found = LinearPoint("u=1", point, True, lag(0.9, 2.0), (lag(0.88, 1.9), lag(0.91, 2.1)))
    gains = found.band("gain")
    assert gains is not None
    low, high = gains
    # Jackknife error 0.1 over two folds, Student's t of one degree of freedom 6.31.
    assert (low[0, 0], high[0, 0]) == pytest.approx((2.0 - 0.631, 2.0 + 0.631), abs=1e-3)
    (band,) = mode_bands(found.model, found.folds)
    assert band is not None
    frequencies = [one.modes()[0][1] for one in found.folds]
    assert band[0][0] <= min(frequencies)
    assert band[1][0] >= max(frequencies)
    # Fold models far apart: the band of the frequency stays between 0 and half the sampling rate.
    wide = LinearPoint("u=1", point, True, lag(0.9, 2.0), (lag(0.2, 1.0), lag(0.99, 3.0)))
    (band,) = mode_bands(wide.model, wide.folds)
    assert band is not None
    assert 0.0 < band[0][0] < band[1][0] <= 0.5
    # A fold without such a mode counts as one that has none.
    late = LinearPoint("u=1", point, True, lag(0.9, 2.0), (lag(0.88, 1.9), lag(-0.2, 2.1)))
    assert mode_bands(late.model, late.folds) == [None]
    alone = LinearPoint("u=1", point, True, lag(0.9, 2.0), (lag(0.88, 1.9),))
    assert alone.band("gain") is None
    assert mode_bands(alone.model, alone.folds) == [None]


def test_poles_without_dynamics_in_the_sampled_model_are_named() -> None:
    poles = np.diag([0.9, 1e-6, 0.0, 0.01])
    model = LinearModel(
        poles, np.ones((4, 1)), np.ones((1, 4)), np.zeros((1, 1)), 0.5, np.zeros(1), np.zeros(1)
    )
    lines = list(_pole_lines(_dynamics(model)["poles"], 0.5))
    assert len(lines) == 3
    assert "above 1 Hz, half the sampling frequency" in lines[1]
    assert "0, 2 times" in lines[2]
    assert "memory of 2 samples" in lines[2]


def test_a_double_pole_that_rounding_parts_is_real() -> None:
    close = np.array([[0.9, 1e-7], [-1e-7, 0.9]])
    model = LinearModel(
        close, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 0.5, np.zeros(1), np.zeros(1)
    )
    (line,) = _pole_lines(_dynamics(model)["poles"], 0.5)
    assert "0.9 twice" in line
    assert "i " not in line.removeprefix("pole")


def test_the_largest_gain_is_found_at_a_resonance() -> None:
    z = 0.99 * np.exp(0.3j)
    a = np.array([[2 * z.real, -(abs(z) ** 2)], [1.0, 0.0]])
    model = LinearModel(
        a, np.eye(2, 1), np.array([[1.0, 0.0]]), np.zeros((1, 1)), 1.0, np.zeros(1), np.zeros(1)
    )
    fine = np.abs(model.response(np.linspace(0.0, 0.5, 200_001))).max()
    assert largest_gain(model) == pytest.approx(fine, rel=1e-3)


def test_an_integrator_has_no_operating_point_but_at_zero_flow() -> None:
    build = Builder(((1,), (1,)))
    model = LoweredModel(1, 1, 1, 1, False, tank().initial,
                         build.program([0, build.add("add", (0, 1))]))  # fmt: skip
    assert operating_points(model, [np.zeros(1)], np.ones(1)) == []
    assert len(operating_points(model, [np.zeros(1)], np.zeros(1))) == 1


_UNARY = tuple(
    "neg abs sqrt exp log log1p expm1 tanh sin cos tan asin acos atan sinh cosh sign floor".split()  # noqa: SIM905
)


@pytest.mark.parametrize("op", [*_UNARY, "pow", "atan2", "max", "min", "div", "rmax", "rprod"])
def test_derivatives_agree_with_differences(op: str) -> None:
    x, y = np.array([0.3, 0.7]), np.array([0.4, 0.2])
    build = Builder(((2,), (2,)))
    if op.startswith("r"):
        program = build.program([build.add(op, (0,), (0,))])
    elif op in _UNARY:
        program = build.program([build.add(op, (0,))])
    else:
        program = build.program([build.add(op, (0, 1))])
    value, slopes = derivatives(program, [x, y])
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        high, low = (
            derivatives(program, [x + s * step[:2], y + s * step[2:]])[0] for s in (1.0, -1.0)
        )
        assert slopes[:, k] == pytest.approx((high - low) / 2e-6, abs=1e-6)
    assert value.shape == slopes.shape[:1]


def test_joined_states_keep_their_order() -> None:
    assert joined([np.ones((1, 2)), np.zeros(1)]).tolist() == [1.0, 1.0, 0.0]


@pytest.mark.slow
def test_asia_linear_prints_the_linear_models_of_a_run(tmp_path: Path) -> None:
    words = "--experiments", 2, "--retests", 0, "--runs", tmp_path
    done = command_line("run", "two_tanks_sim", *words)
    assert done.code == 0
    shown = command_line("linear", "--runs", tmp_path, "--at", "u=2", "--at", "start", "--to-tf",
                         "--reduce", "auto", "--continuous")  # fmt: skip
    assert shown.code == 0, shown.err
    assert "at u=2: pump_voltage 2 V; tank2_level" in shown.out
    assert "(not at rest)" in shown.out
    assert "standard deviations of outputs for one of inputs, " in shown.out
    assert "% of its largest value" in shown.out
    lines = shown.out.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("continuous order"))
    assert lines[first + 1].startswith("  pole      -")
    (folder,) = tmp_path.glob("*/linear")
    found = json.loads((folder / "linear.json").read_text("utf-8"))
    first = found["points"][0]
    assert first["gain"][0][0] == pytest.approx(
        first["D"][0][0]
        + first["C"][0] @ np.linalg.solve(np.eye(first["order"]) - first["A"], first["B"]),
        rel=1e-6,
    )
    assert (folder / "linear.png").stat().st_size > 10_000
    assert "process models fitted to the records, with 95 % intervals" in shown.out
    # The response of the model itself, with an error of 10 %.
    model = LinearModel(*(np.array(first[name]) for name in "ABCD"), 4.0, np.zeros(1), np.zeros(1))
    f = np.geomspace(1e-4, 0.1, 30)
    np.savez(
        tmp_path / "tank.npz", frequency=f, sampling_time=4.0, response=1.1 * model.response(f)
    )
    shown = command_line("linear", "--runs", tmp_path, "--response", tmp_path / "tank.npz",
                         "--at", "u=2", "--out", tmp_path / "measured")  # fmt: skip
    assert shown.code == 0, shown.err
    assert "by pump_voltage: relative error 9.09% of response tank" in shown.out
    assert (tmp_path / "measured" / "linear_response1.png").stat().st_size > 10_000
    assert command_line("report", "--runs", tmp_path).code == 0
    (page,) = tmp_path.glob("*/report/report.html")
    assert "at u=2: pump_voltage 2 V; tank2_level" in page.read_text("utf-8")
    wrong = command_line("linear", "--runs", tmp_path, "--at", "u=2,3")
    assert wrong.code == 2
    assert "expected start, inputs (pump_voltage) or all outputs (tank2_level)" in wrong.err


@pytest.mark.long
def test_a_controller_and_a_certificate_of_a_run(tmp_path: Path) -> None:
    words = "--experiments", 2, "--retests", 0, "--runs", tmp_path
    assert command_line("run", "two_tanks_sim", *words).code == 0
    # All models of the run are in the loop.
    shown = command_line("control", "--runs", tmp_path, "--at", "u=2", "--settling", "400",
                         "--kind", "lqr", "--limits", "0..3.5", "--json")  # fmt: skip
    assert shown.code == 0, shown.err
    found = json.loads(shown.out)
    assert [one["model"] for one in found["responses"]][:3] == ["loop", "fold 1", "fold 2"]
    assert all(one["settling"] <= 404 for one in found["responses"])
    shown = command_line("control", "--runs", tmp_path, "--model", "1", "--at", "u=2",
                         "--settling", "400", "--kind", "lqr", "--json")  # fmt: skip
    (folder,) = tmp_path.glob("*/control-1")
    assert json.loads((folder / "control.json").read_text("utf-8"))["model"] == "experiment 1"
    models = {one["model"] for one in json.loads(shown.out)["responses"]}
    assert models <= {"loop", "fold 1", "fold 2", "mean of folds"}
    shown = command_line("certify", "--runs", tmp_path, "--model", "1", "--u", "2..2",
                         "--horizon", "2")  # fmt: skip
    assert shown.code == 0, shown.err
    assert "certificate-1.json" in shown.out
    shown = command_line("certify", "--runs", tmp_path, "--u", "1.95..2.05", "--horizon", "5",
                         "--y", "tank2_level=0..10")  # fmt: skip
    assert shown.code == 0, shown.err
    assert "proven    within the limits, from the start, for" in shown.out
    assert "tank2_level in 0 to 10 V" in shown.out
    wrong = command_line("certify", "--runs", tmp_path, "--y", "level=0..10")
    assert "--y is 'level=0..10', expected limits" in wrong.err


def _run(points: Sequence[LinearPoint], pole: float = 0.8) -> LinearRun:
    """Run of one input and output whose records are an open loop with this pole."""
    u = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 60), 5)[:, None]
    y = np.asarray(lfilter([0.0, 0.2], [1.0, -pole], u, axis=0))
    signals = (Signal("u", "V"),), (Signal("y", "m"),)
    return LinearRun(
        "r", "refit", *signals, tuple(points), (), (Trajectory(u, y, 1.0, "a"),), (), np.zeros(1),
    )  # fmt: skip


def _lag(pole: float, gain: float) -> LinearModel:
    one = np.ones((1, 1))
    return LinearModel(pole * one, one, gain * (1 - pole) * one, 0 * one, 1.0, one[0], one[0])


@pytest.mark.parametrize(
    ("pole", "folds", "own", "kind", "reason"),
    [
        (0.9, (0.88, 0.91), 0.8, "gain", ""),
        (0.99, (0.97, 0.999), 0.8, "slope", "includes 1: the plant may integrate"),
        (0.99, (0.985, 0.992), 1.0, "slope", "the plant integrates"),
        (1.02, (1.01, 1.03), 0.8, "gain", "the plant is unstable"),
    ],
)
def test_no_static_gain_and_no_rest_beside_an_integrator_or_an_unstable_pole(
    pole: float, folds: tuple[float, ...], own: float, kind: str, reason: str
) -> None:
    at = OperatingPoint(np.zeros(1), np.ones(1), np.ones(1), 0.0)
    point = LinearPoint("mean", at, True, _lag(pole, 2.0), tuple(_lag(p, 2.0) for p in folds))
    run = _run([point], own)
    assert reason in run.no_rest(point)
    assert bool(run.no_rest(point)) == bool(reason)
    found = run.gain(point, 0, 0)
    assert found[0] == kind
    if "unstable" in reason:
        assert str(found[1]) == "none: the plant is unstable"
    elif kind == "slope":
        # K / tau of a slow lag.
        assert found[1].value == pytest.approx(2.0 * (1 - pole), rel=1e-6)
        assert found[1].unit == "m/V/s"
    else:
        assert found[1].interval is not None


def test_a_mode_that_a_zero_cancels_has_next_to_no_part_of_the_response() -> None:
    a, one = np.diag([0.9, 0.5]), np.ones((2, 1))
    for part in (1e-5, 1.0):
        c = np.array([[0.1, 0.5 * part]])
        model = LinearModel(a, one, c, np.zeros((1, 1)), 1.0, one[:1, 0], one[:1, 0])
        assert model.mode_shares() == pytest.approx([1.0, part], rel=1e-9)


def test_only_the_slowest_pole_has_the_interval_that_includes_one() -> None:
    model = LinearModel(
        np.diag([0.99, 0.7]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 1.0, np.zeros(1),
        np.zeros(1),
    )  # fmt: skip
    first, second = _pole_lines(_dynamics(model)["poles"], 1.0, (0.6, 1.02))
    assert first.endswith("no time constant: its interval includes 1")
    assert second.endswith("time constant 2.804 s")
