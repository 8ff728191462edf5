"""A simulator of the user's own: what is read, tried, calibrated and refused."""

import io
import zipfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.agents.library.registry import families, family
from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.judge.evaluation.control import control_lines
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.plant_check import check_plant
from asia.judge.sandbox.types import Isolation
from asia.models import simulator
from asia.models.methods import LevenbergMarquardt
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.plant import Plant, Unknown
from asia.problem.problem import Problem
from asia.problem.seal import seal
from asia.search.agent_views import problem_facts
from asia.search.run import level_here, prepare

LAG = """
from scipy.signal import lfilter
def simulate(u, params, x0, dt):
    a = 2.718281828 ** (-dt / params["tau"])
    y, _ = lfilter([0, params["gain"] * (1 - a)], [1, -a], u[:, 0], zi=[x0["start"]])
    return y
"""
ROUNDED = LAG.replace("return y", "return (y / 0.05).round() * 0.05")
TRUTH = {"tau": 4.0, "gain": 2.0}
PROBLEM = """
sampling_time = 0.5
inputs = ["force"]
outputs = ["speed"]
data = {{ train = ["one.csv", "two.csv"] }}
budget = {{ fit_seconds = {seconds} }}
[plant]
source = "plant.py:simulate"
[plant.parameters]
tau = {{ min = 0.5, max = 50.0, unit = "s" }}
gain = {{ min = -5.0, max = 5.0 }}
[plant.initial]
start = {{ min = -3.0, max = 3.0 }}
"""


def write(folder: Path, code: str = LAG, seconds: int = 60, noise: float = 0.05) -> Path:
    random = np.random.default_rng(2)
    names: dict[str, Any] = {}
    exec(LAG, names)
    for name, start in (("one", 1.5), ("two", -1.0)):
        u = np.repeat(random.normal(size=40), 8)
        y = names["simulate"](u[:, None], TRUTH, {"start": start}, 0.5)
        table = np.column_stack([np.arange(320) / 2, u, y + noise * random.normal(size=320)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time,force,speed",
                   comments="")  # fmt: skip
    (folder / "plant.py").write_text(code)
    (folder / "problem.toml").write_text(PROBLEM.format(seconds=seconds))
    return folder


def calibrated(problem: Problem, method: LevenbergMarquardt, **settings: Any) -> Any:
    context = search_context(problem, 1)
    model = simulator.build(simulator.Config(**settings), context)
    return simulator.train(model, problem.train, context, method)


def held_inside(model: Any, problem: Problem) -> None:
    found = model.estimates(problem.train, search_context(problem, 1)).parameters
    assert [p.name for p in found] == list(TRUTH)
    assert found[0].unit == "s"
    for one in found:
        assert one.low < TRUTH[one.name] < one.high
        assert one.high - one.low < 0.2 * abs(one.value)


def test_parameters_of_a_simulator_are_found_with_their_intervals(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    model = calibrated(problem, LevenbergMarquardt(iterations=12))
    held_inside(model, problem)
    # The state at the start of a record is that record's own.
    record = problem.train[1]
    past, rest = record[:10], record[10:]
    y = model.simulate(past.u[None], past.y[None], rest.u[None])[0]
    assert np.std(y - rest.y) < 0.06


def test_a_simulator_that_rounds_is_calibrated_without_gradients(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path, ROUNDED))
    context = search_context(problem, 1)
    assert simulator.probe(problem.train, context).parameters()["gradient"] == 0.0
    model = calibrated(problem, LevenbergMarquardt(iterations=15, starts=5))
    for name, value in model.parameters().items():
        assert value == pytest.approx(TRUTH[name], rel=0.05)


@pytest.mark.long
def test_a_residual_is_learned_on_top(tmp_path: Path) -> None:
    # The simulator knows one of the two lags of the plant.
    problem = load_problem(write(tmp_path, noise=0.01))
    second = np.exp(-0.5 / 1.5)
    slow = [r.y.copy() for r in problem.train]
    for y in slow:
        for k in range(1, len(y)):
            y[k] = second * y[k - 1] + (1 - second) * y[k]
    records = [Trajectory(r.u, y, 0.5, r.name) for r, y in zip(problem.train, slow, strict=True)]
    context = search_context(problem, 1)
    errors: list[float] = []
    for residual in (None, "linear"):
        model = simulator.build(simulator.Config(residual=residual), context)
        method = LevenbergMarquardt(iterations=15)
        model = simulator.train(model, records[:1], context, method)
        past, rest = records[1][:10], records[1][10:]
        y = model.simulate(past.u[None], past.y[None], rest.u[None])[0]
        errors.append(float(np.std(y - rest.y)))
    assert errors[1] < 0.5 * errors[0]


def test_the_family_is_offered_first_and_only_with_a_simulator(tmp_path: Path) -> None:
    facts = problem_facts(load_problem(write(tmp_path)))
    assert families(facts)[0].name == "simulator"
    row = family("simulator")
    assert row is not None
    assert "residual" in {p.name for p in row.space(facts).config}
    (tmp_path / "problem.toml").write_text(PROBLEM.format(seconds=60).partition("[plant]")[0])
    assert not row.suits(problem_facts(load_problem(tmp_path)))


def test_a_run_keeps_the_simulator_and_refuses_a_changed_one(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path))
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)))
    again = load_lock(lock)
    assert again.plant == problem.plant
    (tmp_path / "plant.py").write_text(ROUNDED)
    with pytest.raises(UserError, match="the plant changed since the run began"):
        load_lock(lock)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("plant.py:simulate", "simulate", "expected 'plant.py:simulate'"),
        ("plant.py:simulate", "plant:simulat", "no top-level function 'simulat'.*simulate"),
        ("plant.py:simulate", "other.py:simulate", "other.py"),
        ("min = 0.5, max = 50.0", "min = 5, max = 5", "min must be below max"),
        ("start =", "tau =", "keep one"),
        ("unit =", "units =", "unknown key 'units'"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, before: str, after: str, message: str) -> None:
    path = write(tmp_path) / "problem.toml"
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(UserError, match=message):
        load_problem(tmp_path)


def test_a_function_of_other_arguments_is_refused_unexecuted(tmp_path: Path) -> None:
    write(tmp_path, "raise SystemExit\ndef simulate(u): pass")
    with pytest.raises(UserError, match="takes 1 arguments, expected 4"):
        load_problem(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return params['mass'] * u", "failed at tau=5, gain=0, start=0: KeyError: 'mass'"),
        (
            "print('a\\nb')\n    return 1 / 0",
            r"ZeroDivisionError: division by zero; it printed: a | b",
        ),
        ("return u / (u * 0)", "returned NaN or infinity at sample 1"),
        ("import random\n    return u * random.random()", "other outputs for the same arguments"),
        ("return params['gain'] + params['tau'] * u[::-1]", "looks ahead"),
        ("import os\n    os._exit(3)", "ended its process"),
        ("while True: pass", "did not return within 4 s"),
    ],
)
def test_a_bad_simulator_ends_in_one_sentence(tmp_path: Path, body: str, message: str) -> None:
    write(tmp_path, f"def simulate(u, params, x0, dt):\n    {body}\n", 4)
    with pytest.raises(UserError, match=message) as caught:
        check_plant(load_problem(tmp_path), Isolation.PROCESS)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_search_does_not_begin_with_a_bad_simulator(tmp_path: Path) -> None:
    write(tmp_path, "def simulate(u, params, x0, dt):\n    return params['mass'] * u\n", 20)
    with pytest.raises(UserError, match="failed at tau=5, gain=0, start=0: KeyError: 'mass'"):
        prepare(load_problem(tmp_path), "expert", seed=1, runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_parameters_without_separate_effect_are_named(tmp_path: Path) -> None:
    twice = LAG.replace('params["gain"]', '(params["gain"] + params["tau"])').replace(
        '/ params["tau"]', "/ 4.0"
    )
    found = check_plant(load_problem(write(tmp_path, twice)), level_here())
    assert any("tau, gain cannot be told apart in record one" in line for line in found)


def test_records_in_memory_take_a_function_or_its_file(tmp_path: Path) -> None:
    """Check that the file of the function is copied, and another one is another problem."""
    (tmp_path / "plant.py").write_text(LAG)
    spec = spec_from_file_location("plant", tmp_path / "plant.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    known = {"parameters": {"tau": {"min": 0.5, "max": 50.0}, "gain": Unknown(-5.0, 5.0)}}
    u = np.repeat(np.random.default_rng(0).normal(size=30), 8)

    def made(source: Any) -> Problem:
        y = module.simulate(u[:, None], TRUTH, {"start": 0.0}, 0.5)
        return Problem.from_arrays(u, y, sampling_time=0.5, directory=tmp_path / "made",
                                   plant={"source": source, **known})  # fmt: skip

    known["initial"] = {"start": Unknown(-3.0, 3.0)}
    problem = made(module.simulate)
    assert problem.plant is not None
    assert problem.plant.source == f"{tmp_path / 'made' / 'plant.py'}:simulate"
    assert problem.plant.parameters["gain"] == Unknown(-5.0, 5.0)
    assert made(f"{tmp_path}/plant.py:simulate").plant == problem.plant
    (tmp_path / "plant.py").write_text(ROUNDED)
    with pytest.raises(UserError, match=r"another problem \(plant.py differs\)"):
        made(module.simulate)
    with pytest.raises(UserError, match="not at the top level of a Python file"):
        made(lambda u, params, x0, dt: u)
    with pytest.raises(UserError, match="put the simulator there"):
        made("missing.py:simulate")


@pytest.mark.slow
def test_a_unit_of_asias_own_export_is_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from asia.export.targets.fmu import FmuTarget
    from tests.unit.export import models
    from tests.unit.export.models import linear_model, ready

    fmpy: Any = pytest.importorskip("fmpy")
    if FmuTarget().missing():
        pytest.skip(str(FmuTarget().missing()))
    # The same model whatever other tests drew before.
    monkeypatch.setattr(models, "rng", np.random.default_rng(0))
    model = ready(linear_model(0)).model
    unit = FmuTarget().print(model).files["model_fmi2.fmu"]
    assert isinstance(unit, bytes)
    (tmp_path / "model.fmu").write_bytes(unit)
    (tmp_path / "problem.toml").write_text(
        """
sampling_time = 0.5
inputs = ["u0"]
outputs = ["y0", "y1"]
data = { train = ["one.csv"] }
[plant]
source = "model.fmu"
[plant.parameters]
u1 = { min = -5.0, max = 5.0, unit = "V" }
"past_y[3,1]" = { min = -10.0, max = 10.0 }
"""
    )
    random = np.random.default_rng(0)
    u = np.repeat(random.normal(1.0, 0.5, 30), 5)
    names = ["time,u0,y0,y1", "plant"]
    truth = {"u1": 1.7, "past_y[3,1]": 4.0}
    signals = np.zeros(151, [("time", float), ("u0", float)])
    signals["time"], signals["u0"] = np.arange(151) * 0.5, np.append(u, u[-1])
    rows = fmpy.simulate_fmu(
        str(tmp_path / "model.fmu"), stop_time=75.0, step_size=0.5, output_interval=0.5,
        start_values=truth, input=signals, output=["y0", "y1"],
    )  # fmt: skip
    y = np.stack([rows["y0"], rows["y1"]], axis=1)[1:]
    table = np.column_stack([np.arange(150) / 2, u, y + 0.02 * random.normal(size=y.shape)])
    np.savetxt(tmp_path / "one.csv", table, delimiter=",", header=names[0], comments="")
    problem = load_problem(tmp_path)
    assert isinstance(problem.plant, Plant)
    # The same from arrays: the unit is copied to the problem.
    unknown = {**problem.plant.table, "source": str(tmp_path / "model.fmu")}
    same = Problem.from_arrays(
        u, y, sampling_time=0.5, directory=tmp_path / "arrays", inputs=["u0"],
        outputs=["y0", "y1"], plant=unknown,
    )  # fmt: skip
    assert same.plant is not None
    assert (same.plant.digest, same.plant.is_unit) == (problem.plant.digest, True)
    # In the sandbox too, from the folder that workers may read.
    assert "determines every parameter" in check_plant(problem, level_here())[-1]
    fitted = calibrated(problem, LevenbergMarquardt(iterations=4))
    found = fitted.estimates(problem.train, search_context(problem, 1)).parameters
    for one in found:
        assert one.low < truth[one.name] < one.high
        assert one.high - one.low < 1.0


@pytest.mark.long
def test_a_unit_makes_a_step_for_each_sample_of_a_closed_loop(tmp_path: Path) -> None:
    """Sample by sample the same outputs as at once, in the sandbox too, and twice the same."""
    from asia.export.targets.fmu import FmuTarget
    from tests.unit.export.models import linear_model, ready
    from tests.unit.problem.small_control import PROBLEM, write_control_problem

    pytest.importorskip("fmpy")
    if FmuTarget().missing():
        pytest.skip(str(FmuTarget().missing()))
    unit = FmuTarget().print(ready(linear_model(0)).model).files["model_fmi2.fmu"]
    assert isinstance(unit, bytes)
    text = (
        PROBLEM.replace('"plant.py:step"', '"model.fmu"')
        .replace("gain = { min = 1.9, max = 2.1 }", '"past_y[3,1]" = { min = 1.9, max = 2.1 }')
        .replace("load = {", "u1 = {")
        .replace('["y"]', '["y0"]')
        .replace('["u"]', '["u0"]')
        .replace("\nu = {", "\nu0 = {")
        .replace("\ny = ", "\ny0 = ")
    )
    folder = write_control_problem(tmp_path / "lag", text)
    with pytest.raises(UserError, match=r"model.fmu.*put the simulator there"):
        load_problem(folder)
    (folder / "model.fmu").write_bytes(unit)
    records = (folder / "open.csv").read_text().replace("time,u,y", "time,u0,y0")
    (folder / "open.csv").write_text(records)
    # The unit was exported with another sampling time.
    with pytest.raises(UserError, match=r"model.fmu failed: .*fmi2DoStep failed"):
        control_lines(load_problem(folder), level_here())
    faster = text.replace("time = 1.0", "time = 0.5")
    faster = faster.replace('train = ["open.csv"]', 'train = ["open.csv"]\ntime = "none"')
    (folder / "problem.toml").write_text(faster)
    problem = load_problem(folder)
    assert problem.control is not None
    assert "inputs held at their start cost" in control_lines(problem, level_here())[-1]
    base = problem.control.base
    inputs = (*base.inputs, Signal("u1"))
    context = Context(inputs, base.outputs, 0.5, 0, 0, plant=problem.control.plant)
    model = simulator.stepped(context)
    u = np.random.default_rng(0).normal(size=(1, 30, 2))
    seen = np.concatenate([u[:, :1], u], axis=1)
    both = np.concatenate([seen, np.full((1, 31, 1), 2.0)], axis=2)
    first, again = (model.simulate(both[:, :, :0], both[:, :, :0], both) for _ in range(2))
    place = np.log([2.0 / 1.9]) / np.log(2.1 / 1.9)
    at_once = model.simulator.run(u[0], place, np.zeros(0))
    assert np.array_equal(first, again)
    assert first[0, 1:] == pytest.approx(at_once, abs=1e-12)
    # Without co-simulation there is no step to make.
    with zipfile.ZipFile(io.BytesIO(unit)) as archive:
        described = archive.read("modelDescription.xml").replace(b"CoSimulation", b"ModelExchange")
    with zipfile.ZipFile(folder / "model.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", described)
    with pytest.raises(UserError, match="has no co-simulation"):
        load_problem(folder)
