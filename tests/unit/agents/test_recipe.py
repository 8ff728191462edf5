from hypothesis import given
from hypothesis import strategies as st

from asia.agents._library import FAMILIES
from asia.agents._recipe import Recipe, read_recipe
from asia.candidate import check_source, source_digest
from asia.evaluation import LINEAR

values = st.one_of(
    st.integers(-5, 500),
    st.floats(1e-6, 1e3),
    st.booleans(),
    st.none(),
    st.sampled_from(["rnn", "gru", "state"]),
    st.lists(st.sampled_from(["x1", "x2", "level"]), max_size=3).map(tuple),
)
settings = st.dictionaries(st.sampled_from(["a", "hidden", "ridge", "offset"]), values).map(
    lambda d: tuple(d.items())
)


@given(
    recipe=st.builds(
        Recipe,
        family=st.sampled_from([row.name for row in FAMILIES]),
        config=settings,
        method=st.sampled_from(["Adam", "LevenbergMarquardt"]),
        options=settings,
    )
)
def test_a_recipe_survives_its_source(recipe: Recipe) -> None:
    source = recipe.source("Anything.")
    check_source(source)
    assert read_recipe(source) == recipe


def test_a_strangers_source_is_no_recipe() -> None:
    assert read_recipe("def fit(t, c): ...") is None
    assert read_recipe("def fit(:") is None
    assert read_recipe("from asia.models import ltc\nc = ltc.Config(hidden=n)\nAdam()") is None


def test_the_linear_rung_and_the_linear_row_are_the_same_candidate() -> None:
    row = next(row for row in FAMILIES if row.name == "linear")
    recipe = read_recipe(LINEAR)
    assert recipe is not None
    assert recipe.config == (("order", None), ("delay", None))
    assert source_digest(LINEAR) == source_digest(recipe.source(row.use))
