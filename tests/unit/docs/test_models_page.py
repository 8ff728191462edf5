"""The page of models lists what there is, and its example is a candidate that fits."""

import pkgutil
import re
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np

import asia.models
from asia.candidate import Context, check_source
from asia.data import Signal, Trajectory
from asia.models import methods, static_maps

PAGE = (Path(__file__).parents[3] / "docs" / "models.md").read_text()


def section(title: str) -> str:
    """Text under a heading, to the next one."""
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    """Code words in the first column of the tables in a text."""
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    return [word for row in rows for word in re.findall(r"`(\w+)`", row.split("|")[1])]


def example() -> str:
    blocks = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    return next(block for block in blocks if "def fit(" in block)


def test_every_family_has_one_row() -> None:
    names = [m.name for m in pkgutil.iter_modules(asia.models.__path__) if m.name[0] != "_"]
    families = [n for n in names if hasattr(import_module(f"asia.models.{n}"), "Config")]
    families.remove("static_maps")  # functions around a family
    titles = ("Families with your equations", "Classical families", "Networks")
    listed = [name for title in titles for name in first_cells(section(title).split("\nWhat ")[0])]
    assert sorted(listed) == sorted(families)


def test_every_static_function_has_a_row() -> None:
    listed = re.findall(r'"(\w+)"', section("Static functions around every family"))
    kinds = {*get_args(static_maps.InputMap), *get_args(static_maps.OutputMap)}
    assert set(listed) == kinds


def test_every_training_method_has_one_row() -> None:
    listed = first_cells(section("Training methods"))
    assert sorted(listed) == sorted(methods.__all__)


def test_families_named_as_a_start_exist() -> None:
    rows = section("Where to start").splitlines()
    named = {word for row in rows for word in re.findall(r"`(\w+)`", row)}
    assert named
    assert all(hasattr(import_module(f"asia.models.{name}"), "Config") for name in named)


def test_the_example_is_a_candidate_and_fits() -> None:
    check_source(example())
    quick = example().replace("steps=3000", "steps=3").replace("hidden=16", "hidden=2")
    assert quick != example()
    candidate: dict[str, Any] = {}
    exec(quick, candidate)
    u = np.random.default_rng(0).normal(size=80)
    y = np.convolve(u, 0.8 ** np.arange(20))[:80]
    record = Trajectory(u, y, 0.1, "run")
    context = Context((Signal("u"),), (Signal("y"),), 0.1, n_past_u=3, n_past_y=3)
    model = candidate["fit"]([record], context)
    past_u, past_y = record.u[None, :3], record.y[None, :3]
    assert model.simulate(past_u, past_y, record.u[None, 3:]).shape == (1, 77, 1)
