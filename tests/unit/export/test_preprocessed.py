"""Exported models of problems with [preprocess], and the command that exports."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.data import Array
from asia.data.preprocess import Preprocess
from asia.errors import UserError
from asia.export.pipeline import kept_delays, measured, measured_window
from asia.lowering.evaluation import simulate
from tests.unit.interfaces.cli.conftest import command_line

from .models import CONTEXT, MODELS, PAST, ready

INPUTS = CONTEXT.inputs


@pytest.mark.parametrize(
    ("name", "every", "delay"),
    [
        ("linear", 1, {"u0": 4}),
        ("linear", 2, {"u0": 2, "u1": 6}),
        ("gru", 2, {}),
        ("gru", 2, {"u0": 2, "u1": 6}),
    ],
)
def test_it_reads_and_gives_what_is_measured(name: str, every: int, delay: dict[str, int]) -> None:
    done = Preprocess(delay, every)
    model = MODELS[name]()
    low = measured(ready(model).model.lowered, done, INPUTS)
    low.check()
    rng = np.random.default_rng(0)
    longest, samples = done.longest_delay, 24 * every
    u = rng.uniform(-1, 1, (PAST * every + longest + samples, 2)) + 3.0
    past_y = rng.uniform(-1, 1, (PAST * every, 2))
    acting, past = done.inputs(u, INPUTS), done.outputs(past_y)
    y = model.simulate(acting[None, :PAST], past[None], acting[None, PAST:])[0]
    means = u.reshape(-1, every, 2).mean(axis=1)
    begin = PAST + longest // every
    found = simulate(low, means[:begin], past_y[::every], means[begin:])
    expected = done.refined(y, samples)[::every]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 if low.single else 1e-10)


def test_windows_of_the_training_records_are_as_they_were_measured(tmp_path: Path) -> None:
    done = Preprocess({"u0": 4})
    given = ready(MODELS["linear"]())
    low = measured(given.model.lowered, done, INPUTS)
    windows = tuple(measured_window(w, done, INPUTS) for w in given.windows)
    for window in windows:
        found = simulate(low, window.past_u, window.past_y, window.u)
        np.testing.assert_allclose(found, window.y_hat, rtol=1e-10, atol=1e-10)
    assert [len(w.u) for w in windows] == [len(w.u) - 4 for w in given.windows]


def test_a_delay_between_two_kept_samples_is_refused() -> None:
    with pytest.raises(UserError, match="no multiple of decimate 2"):
        kept_delays(Preprocess({"u1": 3}, 2), INPUTS)
    assert kept_delays(Preprocess({"u1": 6}, 2), INPUTS) == [0, 3]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The baseline alone, on records of 2 inputs that were delayed, thinned out and standardised
    in each fold."""
    folder = tmp_path_factory.mktemp("mill")
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, (90, 2)), 4, axis=0)
    y = np.zeros(len(u))
    for k in range(4, len(u)):
        y[k] = 0.8 * y[k - 1] + 0.3 * u[k - 4, 0] + 0.1 * u[k - 1, 1]
    y = 20.0 + 5.0 * y + 0.01 * rng.standard_normal(len(y))
    rows = np.column_stack([0.1 * np.arange(len(u)), u, y])
    path = folder / "log.csv"
    np.savetxt(path, rows, delimiter=",", header="t,u1,u2,y", comments="", fmt="%.9f")
    made = command_line(
        "init", folder / "mill", "--train", path, "--inputs", "u1", "u2", "--outputs", "y",
        "--time", "t", "--decimate", 2, "--detrend", "--scale",
    )  # fmt: skip
    assert made.code == 0, made.err
    toml = folder / "mill" / "problem.toml"
    text = toml.read_text()
    assert "[preprocess]" in text
    toml.write_text(text.replace("[preprocess]", "[preprocess]\ndelay = { u1 = 4 }", 1))
    done = command_line("run", folder / "mill", "--experiments", 1, "--runs", folder / "runs")
    assert done.code == 0, done.err
    (found,) = [p.parent for p in (folder / "runs").glob("*/ledger.jsonl")]
    return found


@pytest.mark.slow
def test_the_command_exports_what_simulate_gives(run: Path, tmp_path: Path) -> None:
    words = ("export", run.name, "--runs", run.parent, "--to", "numpy", "--out", tmp_path)
    done = command_line(*words, "--json")
    assert done.code == 0, done.err
    facts = json.loads(done.out)
    assert facts["target"] == "numpy"
    assert max(facts["parity"].values()) < 1e-9
    assert facts["bytes"] > 0
    assert facts["microseconds_per_step"]["numpy"] > 0
    assert all(Path(path).is_file() for path in facts["files"])
    assert "one sample in 2" in (tmp_path / "numpy" / "USE.md").read_text()
    told = json.loads((tmp_path / "numpy" / "model.json").read_text())
    assert told["sampling_time"] == pytest.approx(0.2)
    u, past_y = _measured(told["past_inputs"], told["past_outputs"])
    begin = told["past_inputs"]
    expected = asia.simulate(run, u[: 2 * begin], past_y, u[2 * begin :])
    means = u.reshape(-1, 2, 2).mean(axis=1)
    model = _loaded(tmp_path / "numpy" / "model.py")
    found = model.simulate(means[:begin], past_y[::2], means[begin:])
    np.testing.assert_allclose(found, expected[::2], rtol=1e-9)


def _measured(past_u: int, past_y: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(2)
    return rng.uniform(-1, 1, (2 * past_u + 40, 2)), 20.0 + rng.standard_normal((2 * past_y, 1))


def _loaded(path: Path) -> object:
    spec = importlib.util.spec_from_file_location("printed_model", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "--to is missing: one of numpy"),
        (("--to", "fortran"), "fortran"),
        (("--to", "numpy", "--model", "best"), "--model is 'best', expected ensemble"),
        (("--to", "numpy", "--model", "7"), "has no scored experiment 7"),
        (("--to", "numpy", "--model", "stack"), "stack"),
    ],
)
def test_what_cannot_be_exported_is_refused(run: Path, words: tuple[str, ...], says: str) -> None:
    done = command_line("export", run.name, "--runs", run.parent, *words)
    assert done.code == 2
    assert says in done.err
    assert not (run / "export").exists()


@pytest.mark.slow
def test_the_monitor_reads_what_was_measured_and_prints_an_observer(
    run: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-1, 1, (200, 2)), 4, axis=0)
    gain = np.where(np.arange(len(u)) < 500, 1.0, 0.6)
    y = np.zeros(len(u))
    for k in range(4, len(u)):
        y[k] = 0.8 * y[k - 1] + 0.3 * gain[k] * u[k - 4, 0] + 0.1 * u[k - 1, 1]
    y = 20.0 + 5.0 * y + 0.01 * rng.standard_normal(len(y))
    start = np.datetime64("2026-03-02T08:00:00")
    with (tmp_path / "week.csv").open("w") as file:
        file.write("t,u1,u2,y\n")
        for k, row in enumerate(np.column_stack([u, y]).tolist()):
            file.write(f"{start + np.timedelta64(100 * k, 'ms')},{','.join(map(str, row))}\n")
    words = (run.name, tmp_path / "week.csv", "--runs", run.parent, "--out", tmp_path)
    done = command_line("monitor", *words, "--parameter", "gain(u1)")
    assert done.code == 1, done.err
    # The change comes 50 s after the start.
    assert re.search(r"no longer valid since 2026-03-02 08:00:(4[5-9]|5[0-5])", done.out), done.out
    assert done.out.count("no longer valid") == 1
    assert re.search(r"gain\(u1\): 0\.(5[89]|6[012])", done.out), done.out
    assert (tmp_path / "monitor.png").stat().st_size > 10_000
    wrong = command_line("monitor", *words, "--parameter", "gain(u3)")
    assert wrong.code == 2
    assert "no signal 'u3'" in wrong.err
    wrong = command_line("monitor", *words, "--parameter", "mass")
    assert wrong.code == 2
    assert "has no parameters that can change in time" in wrong.err
    words = ("export", run.name, "--runs", run.parent, "--to", "c", "--out", tmp_path, "--observer")
    done = command_line(*words, "--parameter", "offset(y)", "--json")
    assert done.code == 0, done.err
    _, facts = (json.loads(line) for line in done.out.splitlines())
    assert facts["parity"]["c observer"] is None or facts["parity"]["c observer"] < 1e-9
    assert "offset_y_" in (tmp_path / "c" / "observer" / "observer.h").read_text()
