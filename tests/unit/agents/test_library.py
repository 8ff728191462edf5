"""Every row writes configurations that its family and its methods accept."""

import importlib
from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest

from asia.agents import Facts, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.moves import all_moves
from asia.agents.library.family import Family, under_protocol
from asia.agents.library.methods import by_lbfgs
from asia.agents.library.move import Situation
from asia.agents.library.registry import all_families, families
from asia.agents.random import _drawn
from asia.models import methods
from asia.models._networks.objective import check_structure
from asia.testing.family import check_recipe, family_problem
from tests.unit.agents.searches import (
    CLEAN,
    body,
    recipe_of,
    search,
    simulation,
    view,
    windows,
)

ODD = {"odd": {"u": "-u", "y": "-y"}}
PROBLEMS = {
    "physics": simulation(physics=True),
    "long": replace(simulation(physics=False, samples=100_000), symmetry=ODD),
    "windows": windows(),
    "body": body(),
    "validation": replace(windows(), early_stopping="validation"),
}
SOME = [pytest.param(PROBLEMS[name], id=name) for name in ("physics", "body")]


@pytest.mark.slow
@pytest.mark.parametrize("known", SOME)
@pytest.mark.parametrize("row", all_families(), ids=lambda row: row.name)
def test_recipes_of_a_row_are_accepted(row: Family, known: Facts) -> None:
    if not row.suits(known):
        return
    trial, full = row.trial(known), row.full(known)
    assert trial.family == full.family == row.name
    for recipe in (trial, full, *(change(known, trial) for change in row.methods)):
        check_recipe(under_protocol(recipe, row, known))
    rng = np.random.default_rng(0)
    for _ in range(30):
        check_recipe(under_protocol(_drawn(rng, row, known), row, known))


@pytest.mark.parametrize(
    "row",
    [row for row in all_families() if by_lbfgs in row.methods],
    ids=lambda row: row.name,
)
def test_a_network_accepts_random_draws(row: Family) -> None:
    """Among it all that Adam asks of a structure: a state to carry, an output fed back."""
    known, rng = PROBLEMS["long"], np.random.default_rng(0)
    _, context = family_problem(row)
    module = importlib.import_module(f"{row.package}.{row.name}")
    checked = 0
    for _ in range(60):
        recipe = _drawn(rng, row, known)
        if recipe.method == "Adam":
            config = dict(recipe.changed(**dict(row.small)).config)
            model = module.build(module.Config(**config), context)
            check_structure(model.cell, model.params, methods.Adam(**dict(recipe.options)))
            checked += 1
    assert checked > 10


@pytest.mark.parametrize("row", all_families(), ids=lambda row: row.name)
def test_a_row_varies_settings_that_exist(row: Family) -> None:
    known = PROBLEMS["body" if row.name == "physics_net" else "physics"]
    space = row.space(known)
    module = importlib.import_module(f"{row.package}.{row.name}")
    of_methods = {f.name for f in fields(getattr(methods, row.trial(known).method))}
    if "network" in {need.needs for need in space.options}:
        of_methods |= {f.name for f in fields(methods.Adam)}
    assert {p.name for p in space.config} <= {f.name for f in fields(module.Config)}
    assert {p.name for p in space.options} <= of_methods
    if "features" in {f.name for f in fields(module.Config)}:
        assert space.find("features") is not None


@pytest.mark.slow
@pytest.mark.parametrize("known", SOME)
def test_proposals_of_the_expert_are_accepted(known: Facts) -> None:
    for done in search(ExpertAgent, known, 60):
        check_recipe(recipe_of(done))


@pytest.mark.parametrize("known", PROBLEMS.values(), ids=PROBLEMS)
def test_random_draws_the_settings_of_moves_too(known: Facts) -> None:
    """The control has the expert's families, methods and settings, or the comparison means little.
    A layer may be added where none is named; a network beside equations is drawn as a method."""
    made = 0
    for row in families(known):
        drawn = {p.name for p in (*row.space(known).config, *row.space(known).options)}
        starts = [row.full(known), *(change(known, row.full(known)) for change in row.methods)]
        # Some moves are for searches in which no model beats the mean.
        for recipe, value in product(starts, (0.3, 1.3)):
            now = view(known, (), "refine")
            trial = Trial(
                1, None, "explore", row.name, "", "", "", recipe.source(""), "keep", value,
                (value, value), None, (CLEAN, CLEAN),
            )  # fmt: skip
            others = [replace(trial, number=n, family=name) for n, name in ((2, "a"), (3, "b"))]
            case = Situation(replace(now, trials=(trial, *others)), trial, recipe, row, 0)
            for move in all_moves():
                if move.applies(case) and move.evidence(case):
                    changed = move.change(case)
                    made += 1
                    if changed.method == recipe.method:
                        new = {*changed.config, *changed.options} - {
                            *recipe.config, *recipe.options
                        }  # fmt: skip
                        assert {name for name, _ in new} <= drawn | {"layers", "network"}, move.name
    assert made > 50


@pytest.mark.parametrize("known", PROBLEMS.values(), ids=PROBLEMS)
def test_a_long_fit_is_no_shorter_than_a_trial(known: Facts) -> None:
    longer = 0
    for row in families(known):
        trial, full = row.trial(known), row.full(known)
        assert full.config == trial.config
        assert full.number("steps", 0) >= trial.number("steps", 0)
        longer += full.number("steps", 0) > 2 * trial.number("steps", 0)
    assert longer >= 5
