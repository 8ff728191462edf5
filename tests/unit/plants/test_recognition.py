"""Plants are recognised by words, units and records, and unknown ones are called so."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from asia.data import Signal, Trajectory
from asia.plants.catalogue import catalogue
from asia.plants.recognition import assignments, likely, recognise, recognition_lines
from asia.problem.problem import DESCRIPTION_TEMPLATE

SYSTEMS: list[dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("descriptions.toml").read_text(encoding="utf-8")
)["system"]


def signals(texts: list[str]) -> tuple[Signal, ...]:
    return tuple(Signal(*text.split(" ", 1)) for text in texts)


def found_in(system: dict[str, Any]) -> list[str]:
    ranked = recognise(system["description"], signals(system["inputs"]), signals(system["outputs"]))
    return [one.plant.name for one in likely(ranked)]


def test_descriptions_of_engineers_are_recognised() -> None:
    known = [s for s in SYSTEMS if s["plant"]]
    assert len(known) >= 40
    assert all(s["plant"] in catalogue() for s in known)
    right = sum(s["plant"] in found_in(s) for s in known)
    assert right >= 0.9 * len(known)


def test_other_plants_are_unknown() -> None:
    others = [s for s in SYSTEMS if not s["plant"]]
    assert len(others) >= 20
    assert sum(not found_in(s) for s in others) >= 0.9 * len(others)


def test_a_plant_needs_its_signals() -> None:
    text = "A crane with a trolley and a swinging load on a rope."
    inputs = signals(["force N"])
    both = recognise(text, inputs, signals(["position m", "sway rad"]))
    assert both[0].plant.name == "gantry_crane"
    one = recognise(text, inputs, signals(["sway rad"]))
    assert "gantry_crane" not in [found.plant.name for found in one]


def test_units_of_another_quantity_fill_no_role() -> None:
    plant = catalogue()["tank"]
    assert assignments(plant, signals(["pump l/min"]), signals(["level cm"]))
    assert not assignments(plant, signals(["pump degC"]), signals(["level cm"]))


def test_names_assign_signals_to_roles() -> None:
    plant = catalogue()["single_track"]
    found = assignments(plant, signals(["v m/s", "delta rad"]), signals(["ay m/s2", "r rad/s"]))
    assert found == ({"speed": "v", "steering": "delta", "lateral": "ay", "yaw_rate": "r"},)


def test_names_that_tell_nothing_leave_several_assignments() -> None:
    plant = catalogue()["coupled_tanks"]
    found = assignments(plant, signals(["a"]), signals(["b", "c"]))
    assert [one["level_1"] for one in found] == ["b", "c"]


def test_an_untouched_description_tells_nothing() -> None:
    text = DESCRIPTION_TEMPLATE.format(name="pump")
    assert recognise(text, signals(["u"]), signals(["y"])) == ()


def test_records_count_for_and_against() -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 60), 10)
    runs_away = np.cumsum(u)[:, None]
    settles = np.convolve(u, np.exp(-np.arange(30) / 3))[: len(u), None]
    text = "A carriage on a rail."
    inputs, outputs = signals(["force"]), signals(["position"])
    scores = {}
    for name, y in (("away", runs_away), ("settled", settles)):
        record = Trajectory(u[:, None], y + 0.01 * rng.standard_normal(y.shape), 1.0, name)
        ranked = recognise(text, inputs, outputs, [record])
        (scores[name],) = [one for one in ranked if one.plant.name == "positioning_axis"]
    assert scores["away"].score > scores["settled"].score
    assert "position integrates" in scores["away"].reasons
    assert "integrates" not in scores["settled"].reasons


def test_lines_name_the_plant_its_reasons_and_the_option() -> None:
    ranked = recognise("Steam heat exchanger.", signals(["q l/min"]), signals(["T degC"]))
    (line, *_) = recognition_lines(ranked)
    assert line.startswith("plant    this looks like: heat exchanger")
    assert "exchanger" in line
    assert line.endswith("--like heat_exchanger")
    assert recognition_lines(()) == ["plant    unknown to the catalogue"]
