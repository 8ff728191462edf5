"""Linear models of measured frequency responses: reading, order, hidden delay, command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from asia.data.frequency import ComplexArray, FrequencyRecord
from asia.data.intake.frequency import read_frequency_response
from asia.data.trajectory import Array, Signal
from asia.errors import UserError
from asia.lowering.linear import LinearModel
from asia.models.frequency_response import fit_frequency_response
from tests.unit.interfaces.cli.conftest import command_line

MODES = ((3.0, 0.01, 1.0), (11.0, 0.008, -0.6))
DELAY = 0.0123


def flexible(f: Array, delay: float = DELAY) -> ComplexArray:
    s, total = 2j * np.pi * f, np.zeros(len(f), np.complex128)
    for frequency, damping, size in MODES:
        w = 2 * np.pi * frequency
        total += size * w * w / (s * s + 2 * damping * w * s + w * w)
    return total * np.exp(-s * delay)


def noisy(seed: int = 0, count: int = 240) -> tuple[Array, ComplexArray, Array]:
    rng, f = np.random.default_rng(seed), np.geomspace(0.5, 60.0, count)
    g = flexible(f)
    deviation = 0.02 * np.abs(g) + 0.002
    return (
        f,
        g + deviation * (rng.normal(size=count) + 1j * rng.normal(size=count)) / 2**0.5,
        deviation,
    )


def of(f: Array, g: ComplexArray, variance: Array | None, step: float = 0.0) -> FrequencyRecord:
    g = g.reshape(len(f), *g.shape[1:]) if g.ndim == 3 else g[:, None, None]
    outputs, inputs = (tuple(Signal(f"{n}{k}") for k in range(c))
                       for n, c in zip("yu", g.shape[1:], strict=True))  # fmt: skip
    return FrequencyRecord("one", f, g, variance, step, inputs, outputs)


@pytest.mark.long
def test_order_modes_and_a_hidden_delay_of_a_flexible_structure_are_found() -> None:
    f, g, deviation = noisy()
    found = fit_frequency_response(of(f, g, (deviation**2)[:, None, None]))
    assert found.model.order == 4
    assert found.error == pytest.approx(1.0, abs=0.1)
    assert found.held_out == pytest.approx(1.0, abs=0.15)
    assert found.delay == pytest.approx(DELAY, rel=0.06)
    low, high = found.delay_band
    assert low < DELAY < high
    assert high - low < 0.3 * DELAY
    modes = sorted(found.model.modes(), key=lambda one: one[1])
    for (_, frequency, damping, _), (true, ratio, _) in zip(modes, MODES, strict=True):
        assert frequency == pytest.approx(true, rel=2e-3)
        assert damping == pytest.approx(ratio, rel=0.1)
    truth = flexible(f)
    assert np.abs(found.response(f)[:, 0, 0] - truth).max() < 0.05 * np.abs(truth).max()


def test_a_sampled_system_with_two_inputs_is_found_exactly() -> None:
    rng = np.random.default_rng(1)
    a = np.array([[0.8, 0.4, 0.0], [-0.4, 0.8, 0.0], [0.0, 0.0, 0.5]])
    true = LinearModel(a, rng.normal(size=(3, 2)), rng.normal(size=(1, 3)), np.zeros((1, 2)), 0.1,
                       np.zeros(2), np.zeros(1))  # fmt: skip
    f = np.linspace(0.02, 4.9, 90)
    found = fit_frequency_response(of(f, true.response(f), None, 0.1))
    assert found.model.order == 3
    assert found.delay == pytest.approx(0.0, abs=1e-4)
    difference = np.sort_complex(found.model.poles) - np.sort_complex(true.poles)
    assert np.abs(difference).max() < 1e-4
    assert np.abs(found.response(f) - true.response(f)).max() < 1e-4


def written(folder: Path) -> dict[str, Path]:
    f, g, deviation = noisy(count=40)
    w, cov = 2 * np.pi * f, np.zeros((1, 1, 40, 2, 2))
    cov[0, 0, :, 0, 0] = cov[0, 0, :, 1, 1] = 0.5 * deviation**2
    tables = {
        "real.csv": ("frequency [Hz],tip/force real,tip/force imag,tip/force std",
                     np.column_stack([f, g.real, g.imag, deviation])),
        "polar.csv": ("omega,magnitude [dB],phase [deg]",
                      np.column_stack([w, 20 * np.log10(np.abs(g)),
                                       np.degrees(np.unwrap(np.angle(g)))])),
    }  # fmt: skip
    paths = {name: folder / name for name in (*tables, "some.npz", "frd.mat", "idfrd.mat")}
    for name, (head, values) in tables.items():
        np.savetxt(paths[name], values, delimiter=",", header=head, comments="", fmt="%.17g")
    np.savez(paths["some.npz"], frequency=f, response=g, variance=deviation**2)
    frd: dict[str, Any] = {"Frequency": w[:, None], "ResponseData": g[None, None], "Ts": 0.0}
    savemat(paths["frd.mat"], {**frd, "FrequencyUnit": "rad/TimeUnit"})
    names = {"InputName": np.array(["force"], object), "OutputName": np.array(["tip"], object)}
    more = {"Frequency": f[:, None], "FrequencyUnit": "Hz", "CovarianceData": cov, **names}
    savemat(paths["idfrd.mat"], {"g": {**frd, **more}})
    return paths


@pytest.mark.parametrize("name", ["real.csv", "polar.csv", "some.npz", "frd.mat", "idfrd.mat"])
def test_five_formats_are_read(tmp_path: Path, name: str) -> None:
    path = written(tmp_path)[name]
    f, g, deviation = noisy(count=40)
    found = read_frequency_response(path)
    np.testing.assert_allclose(found.frequency, f, rtol=1e-9)
    np.testing.assert_allclose(found.response[:, 0, 0], g, rtol=1e-9)
    if name in ("polar.csv", "frd.mat"):
        assert found.variance is None
    else:
        assert found.variance is not None
        np.testing.assert_allclose(found.variance[:, 0, 0], deviation**2, rtol=1e-9)
    if name in ("real.csv", "idfrd.mat"):
        assert (found.outputs[0].name, found.inputs[0].name) == ("tip", "force")


def test_several_responses_of_a_table_are_told_apart(tmp_path: Path) -> None:
    f = np.linspace(1.0, 9.0, 20)
    head, columns = ["frequency"], [f]
    for out in ("a", "b"):
        for into in ("p", "q"):
            head += [f"{out}/{into} real", f"{out}/{into} imag"]
            columns += [f * (1 + (out == "b")), f * (3 + (into == "q"))]
    path = tmp_path / "both.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=",".join(head), comments="")
    found = read_frequency_response(path)
    assert [s.name for s in found.outputs] == ["a", "b"]
    assert [s.name for s in found.inputs] == ["p", "q"]
    np.testing.assert_allclose(found.response[:, 1, 0], f * (2 + 3j))
    np.testing.assert_allclose(found.response[:, 0, 1], f * (1 + 4j))


@pytest.mark.parametrize(
    ("head", "rows", "says"),
    [
        ("frequency,real", 20, "expected real and imag, or magnitude and phase"),
        ("frequency,real,imag", 5, "expected at least 8"),
        ("time,y,u", 20, "no frequency response"),
        ("frequency [parsec],real,imag", 20, "unit 'parsec'"),
    ],
)
def test_what_is_no_frequency_response_is_refused(
    tmp_path: Path, head: str, rows: int, says: str
) -> None:
    values = np.random.default_rng(0).uniform(1, 2, (rows, head.count(",") + 1))
    path = tmp_path / "some.csv"
    np.savetxt(path, values, delimiter=",", header=head, comments="")
    with pytest.raises(UserError, match=says):
        read_frequency_response(path)


def test_a_mat_file_without_one_says_how_to_save_it(tmp_path: Path) -> None:
    savemat(tmp_path / "other.mat", {"x": np.ones(3)})
    with pytest.raises(UserError, match=r"s = struct\('ResponseData'"):
        read_frequency_response(tmp_path / "other.mat")


@pytest.mark.slow
def test_asia_linear_fits_a_file_and_draws_it(tmp_path: Path) -> None:
    f, g, deviation = noisy(count=120)
    path, out = tmp_path / "tip.csv", tmp_path / "out"
    np.savetxt(path, np.column_stack([f, g.real, g.imag, deviation]), delimiter=",",
               header="frequency [Hz],tip/force real,tip/force imag,tip/force std",
               comments="")  # fmt: skip
    done = command_line("linear", path, "--out", out)
    assert done.code == 0, done.err
    assert "order     4, continuous time" in done.out
    assert re.search(r"Hz.*, damping 0\.0", done.out)
    assert "no static gain, as it is measured from 0.5 to 60 Hz alone" in done.out
    found = json.loads((out / "linear.json").read_text("utf-8"))
    assert found["gain"] is None
    # That of the model, beyond what is measured, is the true one within 3 %.
    a, b, c, d = (np.array(found[name]) for name in "ABCD")
    assert (d - c @ np.linalg.solve(a, b)).item() == pytest.approx(0.395, rel=0.03)
    assert found["delay"] == pytest.approx(DELAY, rel=0.3)
    assert (out / "linear.png").stat().st_size > 10_000
    wrong = command_line("linear", path, "--at", "u=2")
    assert wrong.code == 2
    assert "is a file" in wrong.err
