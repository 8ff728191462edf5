"""The expert begins with the plants that a problem looks like, and gives them up when they fail."""

from dataclasses import replace

import pytest

from asia.agents.expert.agent import situations
from asia.agents.library.plants import equations_of, likely_plants, usual_effects
from asia.agents.view import LINEAR, Facts, Trial
from asia.data import Signal
from asia.problem.physics_text import read_physics
from asia.recipe import read_recipe, with_chosen_equations
from asia.search.fair_trial import variants_of

from .searches import following, recipe_of, simulation, trial, view

TANK = "A pump fills a column with water, which drains by gravity through a hole at the bottom."


def described(text: str, inputs: tuple[Signal, ...], outputs: tuple[Signal, ...]) -> Facts:
    known = simulation(physics=False)
    (record,) = known.records
    u, y = (record.u[:, [0] * len(inputs)], record.y[:, [0] * len(outputs)])
    record = replace(record, u=u, y=y)
    return replace(known, description=text, inputs=inputs, outputs=outputs, records=(record,))


def tank() -> Facts:
    return described(TANK, (Signal("pump", "V"),), (Signal("level", "cm"),))


def test_the_equations_of_a_recognised_plant_come_first() -> None:
    known = tank()
    assert [one.plant.name for one in likely_plants(known)] == ["tank"]
    proposal = following(known, (), "explore")
    assert proposal.title == "grey-box: tank with free outflow"
    assert "words: " in proposal.hypothesis
    assert proposal.remark.startswith("this looks like: tank with free outflow (words: ")
    (text,) = recipe_of(proposal).settings["physics"]  # type: ignore[misc]
    physics = read_physics(str(text))
    assert physics.dynamics == {"level": "gain*pump - outflow*sqrt(level)"}


def test_a_sensor_without_sign_is_written_into_the_equations() -> None:
    text = "Two motors drive a pulley by an elastic belt. "
    known = described(text, (Signal("voltage"),), (Signal("speed"),))
    (record,) = known.records
    known = replace(known, records=(replace(record, y=abs(record.y)),))
    told = replace(known, description=f"{text} The sensor gives the magnitude of the speed.")
    found = [equations_of(facts, likely_plants(facts)[0]) for facts in (known, told)]
    assert [["abs(speed)" in text for text in texts] for texts in found] == [[False, True], [True]]


def test_a_lost_plant_is_said_and_the_ladder_follows() -> None:
    known = tank()
    first = replace(trial(following(known, (), "explore"), 1, 0.5), variant=LINEAR)
    second = following(known, (first,), "explore")
    assert second.family != "greybox"
    assert "#01, grey-box: tank with free outflow: no better than the linear model" in second.remark


def test_a_plant_that_leads_gets_its_usual_effects() -> None:
    known = tank()
    first = trial(following(known, (), "explore"), 1, 0.1)
    titles = [following(known, (first,), "refine").title]
    assert "saturation" in usual_effects(known)
    assert titles[0].startswith("grey-box: ")
    assert recipe_of(following(known, (first,), "refine")).get("physics")


def test_equations_of_the_user_come_before_the_catalogue() -> None:
    known = replace(simulation(physics=True), description=TANK)
    assert not recipe_of(following(known, (), "explore")).get("physics")


def test_an_unknown_plant_changes_nothing() -> None:
    known = simulation(physics=False)
    strange = replace(known, description="Weekly sales of umbrellas, with advertising.")
    assert likely_plants(strange) == ()
    assert following(strange, (), "explore") == following(known, (), "explore")


def test_assignments_that_names_leave_open_are_variants_of_one_trial() -> None:
    text = "Two coupled tanks, joined by a pipe; a pump fills the left column. Interacting."
    known = described(text, (Signal("a"),), (Signal("b"), Signal("c")))
    (one, *_) = likely_plants(known)
    assert one.plant.name == "coupled_tanks"
    texts = equations_of(known, one)
    assert len(texts) == 2
    proposal = following(known, (), "explore")
    variants = variants_of(proposal.source, {LINEAR: "linear"}, fair=True)
    assert list(variants) == [LINEAR, "equations 1", "equations 2"]
    second = read_recipe(variants["equations 2"])
    assert second is not None
    assert second.get("physics") == (texts[1],)
    assert second == with_chosen_equations(recipe_of(proposal), "equations 2")


@pytest.mark.parametrize(("value", "variant"), [(0.5, ""), (None, ""), (0.1, LINEAR)])
def test_a_lost_plant_is_not_carried_on(value: float | None, variant: str) -> None:
    known = tank()
    first = replace(trial(following(known, (), "explore"), 1, value), variant=variant)
    second = replace(first, value=0.1, variant="")

    def carried(one: Trial) -> int:
        at = situations(replace(view(known, (one,), "refine"), linear=0.3))
        return sum(bool(s.recipe.get("physics")) for s in at)

    assert (carried(first), carried(second)) == (0, 1)
