import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.agents.library.registry import all_families
from asia.candidate import check_source, source_digest
from asia.judge.evaluation.references import LINEAR
from asia.recipe import Recipe, read_recipe

METHODS = ["Adam", "LBFGS", "LevenbergMarquardt", "LeastSquares", "MultipleShooting", "Anything"]

words = st.sampled_from(["x1", "x2", "level", "square", "it's", 'a "b"', "back\\slash", ""])
numbers = st.one_of(st.integers(-5, 500), st.floats(1e-6, 1e3))
values = st.one_of(
    numbers,
    st.booleans(),
    st.none(),
    words,
    st.lists(words, max_size=3).map(tuple),
    st.lists(numbers, max_size=4).map(tuple),
)
settings = st.dictionaries(st.sampled_from(["a", "hidden", "ridge", "offset"]), values).map(
    lambda d: tuple(d.items())
)
recipes = st.builds(
    Recipe,
    family=st.sampled_from([row.name for row in all_families()]),
    config=settings,
    method=st.sampled_from(METHODS),
    options=settings,
    package=st.sampled_from(["asia.models", "other_package", "other.package"]),
    maps=settings,
)


@pytest.mark.slow
@given(recipe=recipes)
def test_a_recipe_survives_its_source(recipe: Recipe) -> None:
    source = recipe.source("Anything.")
    check_source(source)
    assert read_recipe(source) == recipe


@pytest.mark.parametrize(
    "source",
    [
        "def fit(t, c): ...",
        "def fit(:",
        "\0",
        "from asia.models import ltc\nc = ltc.Config(hidden=n)\nAdam()",
        LINEAR + "\n\ndef more():\n    return 1\n",
        LINEAR.replace("iterations=30", "iterations=10 + 20"),
        LINEAR.replace("order=None", "**{}"),
    ],
)
def test_a_source_that_says_more_is_no_recipe(source: str) -> None:
    assert read_recipe(source) is None


def test_the_linear_reference_and_the_linear_row_are_the_same_candidate() -> None:
    row = next(row for row in all_families() if row.name == "linear")
    recipe = read_recipe(LINEAR)
    assert recipe is not None
    assert recipe.config == (("order", None), ("delay", None), ("periodic", True))
    assert source_digest(LINEAR) == source_digest(recipe.source(row.use))


def test_settings_change_where_they_are_and_their_order_tells_nothing_apart() -> None:
    recipe = Recipe("ltc", (("hidden", 8),), "Adam", (("steps", 10),))
    changed = recipe.changed(hidden=16, steps=20)
    assert (changed.config, changed.options) == ((("hidden", 16),), (("steps", 20),))
    with pytest.raises(KeyError):
        recipe.changed(order=1)
    one = recipe.configured(width=2).configured(tau_max=5.0)
    other = recipe.configured(tau_max=5.0).configured(width=2)
    assert one != other
    assert one.key == other.key
