"""Candidates under benchmarks/rebuilt: short, allowed, and of parts that are there."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from asia.agents.library.recipe import Recipe, read_recipe
from asia.candidate import Context, check_source
from asia.models import greybox
from asia.problem.load import load_problem

ROOT = Path(__file__).parents[4] / "benchmarks" / "rebuilt"
MOST_LINES = 40


@pytest.mark.parametrize("path", sorted(ROOT.glob("*.py")), ids=lambda path: path.stem)
def test_a_rebuilt_candidate_is_short_and_allowed(path: Path) -> None:
    source = path.read_text()
    assert len(source.splitlines()) <= MOST_LINES
    check_source(source)


def test_the_tanks_are_built_with_the_priors_of_a_problem() -> None:
    """The simulated tanks have the same signals and priors, and need no data."""
    candidate = runpy.run_path(str(ROOT / "cascaded_tanks.py"))
    problem = load_problem("two_tanks_sim")
    context = Context(
        problem.inputs, problem.outputs, problem.sampling_time, 5, 5, physics=problem.physics
    )
    model = candidate["build_model"](context)
    assert isinstance(model, greybox.GreyBox)
    assert model.structure.config == candidate["CONFIG"]
    assert len(model.structure.priors) == 2


def test_its_settings_can_be_said_by_a_recipe() -> None:
    candidate = runpy.run_path(str(ROOT / "cascaded_tanks.py"))
    config, method = candidate["CONFIG"], candidate["METHOD"]
    named = ("saturation", "spill", "sensor", "lag", "smooth", "smooth_width")
    recipe = Recipe(
        "greybox",
        tuple((name, getattr(config, name)) for name in named),
        "LevenbergMarquardt",
        (("noise_model", method.noise_model), ("slow_time", method.slow_time)),
    )
    again = read_recipe(recipe.source("The same."))
    assert again == recipe
    assert greybox.Config(**dict(again.config)) == config
