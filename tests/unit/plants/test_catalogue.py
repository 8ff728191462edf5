"""Every entry of the catalogue loads, simulates and is fitted to records of its own equations."""

import dataclasses
import runpy
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.plants.catalogue import Effect, Plant, catalogue, load_plant, plant_named
from asia.problem.physics_text import read_physics, written_physics

from .examples import example_record, example_signals

PLANTS = tuple(catalogue().values())
every_plant = pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.name)


def relative_error(plant: Plant, samples: int, method: LevenbergMarquardt) -> float:
    """Error of a simulation after a fit to 1 % of noise, over the deviation of the outputs."""
    record = example_record(plant, samples, spread=0.1, noise=0.01)
    inputs, outputs = example_signals(plant)
    signals = {one.name: one.name for one in (*inputs, *outputs)}
    text = written_physics(plant.physics(signals, inputs, outputs, [record]))
    context = Context(inputs, outputs, 1.0, 5, 5)
    model = greybox.build(greybox.Config(physics=(text,)), context)
    model = greybox.train(model, [record], context, method)
    y = model.simulate(record.u[None, :5], record.y[None, :5], record.u[None, 5:])[0]
    return float((np.sqrt(((y - record.y[5:]) ** 2).mean(axis=0)) / record.y.std(axis=0)).max())


@every_plant
def test_an_example_simulates_inside_its_ranges(plant: Plant) -> None:
    record = example_record(plant)
    assert np.isfinite(record.y).all()
    assert (record.y.std(axis=0) > 0).all()
    known = plant.example().parameters
    for name, value in plant.example_parameters().items():
        assert known[name].min <= value <= known[name].max, name


@every_plant
def test_equations_follow_the_units_of_the_records(plant: Plant) -> None:
    inputs, outputs = example_signals(plant)
    signals = {one.name: one.name for one in (*inputs, *outputs)}
    record = example_record(plant)
    slow = Trajectory(record.u, record.y, 60.0, record.name)
    found = [plant.physics(signals, inputs, outputs, [r]) for r in (record, slow)]
    assert found[0].dynamics == found[1].dynamics
    assert read_physics(written_physics(found[1])) == found[1]


@pytest.mark.parametrize("name", ["tank", "plug_flow_exchanger"])
def test_an_example_is_fitted(name: str) -> None:
    method = LevenbergMarquardt(iterations=10, starts=4)
    assert relative_error(catalogue()[name], 100, method) < 0.2


@pytest.mark.long
@every_plant
def test_every_example_is_fitted(plant: Plant) -> None:
    assert relative_error(plant, 200, LevenbergMarquardt(iterations=40, starts=8)) < 0.1


def test_effects_are_settings_of_the_grey_box() -> None:
    settings = {one.name for one in dataclasses.fields(greybox.Config)}
    settings |= {one.name for one in dataclasses.fields(LevenbergMarquardt)}
    assert set(get_args(Effect)) <= settings


def test_names_of_the_plant_give_way_to_those_of_the_problem() -> None:
    plant = catalogue()["tank"]
    record = example_record(plant)
    inputs, outputs = (Signal("gain"),), (Signal("outflow"),)
    physics = plant.physics({"inflow": "gain", "level": "outflow"}, inputs, outputs, [record])
    assert physics.dynamics == {"level": "gain_*gain - outflow*sqrt(level)"}
    assert physics.observation == {"outflow": "level"}


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('quantity = "flow"', 'quantity = "flux_"', "inflow has the quantity 'flux_'"),
        ("gain*inflow", "gian*inflow", "undefined symbol 'gian'; did you mean 'gain'"),
        ("title =", "titel =", "unknown key 'titel'"),
        ('unit = "sqrt(level)/dt"', 'unit = "sqrt(height)/dt"', "names 'height'"),
        ("level = { min = 0.0 }", "depth = { min = 0.0 }", "there is no such state"),
        ('effects = ["saturation"', 'effects = ["satiation"', "effects[0] is"),
    ],
)
def test_a_wrong_entry_is_refused(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    text = Path(load_plant.__globals__["_FOLDER"], "entries", "tank.toml").read_text()
    assert old in text
    path = tmp_path / "tank.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError) as refused:
        load_plant(path)
    assert sentence in str(refused.value)


def test_an_unknown_plant_is_refused_with_the_nearest() -> None:
    with pytest.raises(UserError, match="pendulum"):
        plant_named("pendulm")


def test_the_page_lists_the_catalogue() -> None:
    folder = Path(__file__).parents[3] / "docs"
    listed = runpy.run_path(str(folder / "site" / "plants.py"))["listed"]
    assert (folder / "plants.md").read_text().endswith(listed())
