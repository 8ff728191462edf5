"""The expert's decisions on made-up evidence."""

from dataclasses import replace

import numpy as np
import pytest

from asia.agents import AgentStoppedError, AgentView, Facts, Proposal, Trial
from asia.agents.expert import agent
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.diagnosis import COURSE_MOVES, answers, diagnoses, places
from asia.agents.expert.moves import all_moves
from asia.agents.library.cards import neural_ss
from asia.agents.library.move import Situation, plain_title, title_of
from asia.agents.library.registry import families, family
from asia.agents.library.traits import sign_lost
from asia.agents.library.trial_evidence import overfit
from asia.data import Array, Trajectory
from asia.data.statistics import Switching, noise_of_periods, plateau_share
from asia.problem.physics import Correction
from asia.problem.plant import Plant, Unknown
from asia.recipe import Recipe
from tests.unit.agents.records.test_relation import closed_loop, lagged
from tests.unit.agents.searches import (
    CLEAN,
    body,
    following,
    recipe_of,
    search,
    simulation,
    trial,
    view,
    windows,
)

AGENT = ExpertAgent


def climb(known: Facts, values: dict[str, float], rest: float = 0.9) -> tuple[Trial, ...]:
    """Explore until no family is left; V by family."""
    trials: tuple[Trial, ...] = ()
    while True:
        proposal = AGENT().propose(view(known, trials, "explore"))
        if proposal is None or proposal.family in {t.family for t in trials}:
            return trials
        trials = (*trials, trial(proposal, len(trials) + 1, values.get(proposal.family, rest)))


def test_the_ladder_tries_each_family_once_and_physics_first() -> None:
    known = simulation(physics=True)
    ladder = [t.family for t in climb(known, {})]
    assert ladder[0] == "greybox"
    assert ladder == [row.name for row in families(known)]
    plain = simulation(physics=False)
    without = [t.family for t in climb(plain, {})]
    assert without == [row.name for row in families(plain)]
    assert not {"greybox", "hybrid"} & set(without)


def test_the_ladder_follows_the_kind_of_problem() -> None:
    def place(known: Facts, name: str) -> int:
        return [row.name for row in families(known)].index(name)

    short, long = simulation(physics=False), simulation(physics=False, samples=100_000)
    for name in ("subnet", "recurrent"):
        assert place(long, name) < place(short, name), name
    assert place(windows(), "autoregressive") < place(short, "autoregressive")
    assert place(windows(), "autoregressive") < place(windows(), "ltc")
    assert families(body())[0].name == "physics_net"
    assert "physics_net" not in {row.name for row in families(simulation(physics=True))}
    assert "compartments" not in {row.name for row in families(long)}


def test_where_all_states_are_measured_learned_terms_at_named_places_come_first() -> None:
    known = body()
    assert known.physics is not None
    named = replace(
        known.physics,
        dynamics={"x": "v", "v": "-k*x + u + f"},
        corrections={"f": Correction(0.5)},
    )
    known = replace(known, physics=named)
    start = following(known, (), "explore")
    assert start.family == "physics_net"
    bent = (replace(trial(start, 1, 0.4), diagnoses=(("amplitude", 0.8),)),)
    bent = (*bent, trial(following(known, bent, "explore"), 2, 0.6))
    assert [t.family for t in bent] == ["physics_net", "greybox"]
    assert following(known, bent, "explore").title == "physics network: network at the corrections"
    plain = (replace(trial(following(body(), (), "explore"), 1, 0.4), diagnoses=bent[0].diagnoses),)
    plain = (*plain, replace(bent[1], number=2))
    assert following(body(), plain, "explore").title == "physics network: saturated inputs"


def test_a_near_certain_move_interrupts_the_ladder() -> None:
    known = replace(simulation(physics=True), description="Two tanks in series.")
    first = trial(following(known, (), "explore"), 1, 0.3)
    assert following(known, (first,), "explore").family == "nl_lfr"
    sure = replace(first, diagnostics=(replace(CLEAN, top_error=2.0),))
    assert following(known, (sure,), "explore").title == "grey-box: x1 runs over"


def test_a_grey_box_that_fails_on_top_gets_an_overflow_then_only_a_limit() -> None:
    known = replace(simulation(physics=True), description="Two tanks in series.")
    trials = climb(known, {"greybox": 0.3})
    first = replace(trials[0], diagnostics=(replace(CLEAN, top_error=2.0),))
    trials = (first, *trials[1:])
    proposal = following(known, trials)
    assert proposal.title == "grey-box: x1 runs over"
    assert proposal.parent == first.number
    assert 'saturation=("x1",)' in proposal.source
    assert "spill=True" in proposal.source
    worse = trial(proposal, len(trials) + 1, 0.35)
    assert following(known, (*trials, worse)).title == "grey-box: x1 saturates"


def best_linear(known: Facts) -> tuple[Trial, ...]:
    """First trials of families, of which the linear model is the best."""
    trials = climb(known, {"linear": 0.3})
    assert min(trials, key=lambda t: t.value or 9.0).family == "linear"
    return trials


def with_diagnosis(trials: tuple[Trial, ...], *diagnoses: tuple[str, float]) -> tuple[Trial, ...]:
    return tuple(replace(t, diagnoses=diagnoses) if t.family == "linear" else t for t in trials)


@pytest.mark.parametrize("placed", [True, False])
def test_the_strongest_open_diagnosis_is_answered_next(placed: bool) -> None:
    """Without a likely place one static function that does not help is enough."""
    terms = (("|u|", "at the input", 0.6),) if placed else ()
    known = replace(simulation(physics=False), terms=lambda: terms)
    trials = best_linear(known)
    usual = following(known, trials)
    assert "input_map" not in usual.source
    found = with_diagnosis(trials, ("amplitude", 0.44), ("time", 0.2))
    made: list[str] = []
    for _ in range(3):
        proposal = following(known, found)
        made.append(proposal.title)
        found = (*found, trial(proposal, len(found) + 1, 0.35))
    assert made[0] == "linear state-space: saturated inputs"
    second = "rising function of the inputs" if placed else "slow disturbance in the noise"
    assert made[1] == f"linear state-space: {second}"
    drift = with_diagnosis(trials, ("amplitude", 0.2), ("time", 0.5))
    assert following(known, drift).title == "linear state-space: slow disturbance in the noise"


def test_an_answer_counts_as_made_for_any_state_and_blocks_no_weaker_diagnosis() -> None:
    known = simulation(physics=False)
    trials = with_diagnosis(best_linear(known), ("motion", 0.44), ("time", 0.2))
    found = answers(view(known, trials, "refine"))
    assert found["dry friction on {state}"] == 0.44
    assert found["slow disturbance in the noise"] == 0.2
    proposal = following(known, trials)
    made = replace(proposal, title="grey-box: dry friction on x1")
    after = answers(view(known, (*trials, trial(made, len(trials) + 1, 0.35)), "refine"))
    assert found.keys() - after.keys() == {"dry friction on {state}"}


@pytest.mark.parametrize(
    ("term", "where"),
    [
        ("sign(u)", "at the input"),
        ("|y|", "at the output"),
        ("u * x2", "in the dynamics"),
    ],
)
def test_the_place_of_a_missing_term_chooses_the_answers(term: str, where: str) -> None:
    terms = (term, where, 0.6), ("y^3", "in the dynamics", 0.2)
    known = replace(simulation(physics=False), terms=lambda: terms)
    assert places(known) == {where: 0.6}
    found = answers(view(known, with_diagnosis(best_linear(known), ("amplitude", 0.44)), "refine"))
    assert ("saturated inputs" in found) == (where == "at the input")
    assert ("bent sensor" in found) == (where == "at the output")
    assert ("smooth correction of {state}, an input" in found) == (where == "in the dynamics")
    weak = replace(known, terms=lambda: [(t, w, 0.1 * s) for t, w, s in terms])
    assert not places(weak)


def test_the_settings_of_a_clearly_better_linear_model_come_first() -> None:
    settings = ("order", None), ("delay", 0), ("periodic", False), ("regularised", "equation")
    known = replace(simulation(physics=False), linear=settings)
    usual = family("linear")
    assert usual is not None
    recipe = usual.trial(simulation(physics=False))
    baseline = Proposal(recipe.source(""), "baseline", "baseline", "", "")
    seen = view(known, (trial(baseline, 1, 0.3),), "explore")
    better = AGENT().propose(replace(seen, linear=0.28))
    assert better is not None
    assert better.title == "linear state-space: settings of the best linear model"
    found = recipe_of(better)
    assert found is not None
    assert found.config == settings
    equal = AGENT().propose(replace(seen, linear=0.295))
    assert equal is not None
    assert equal.title != better.title
    # It takes no integrators, levels, noise model or further state.
    at = Situation(seen, trial(better, 2, 0.28), found, usual, 0)
    stuck = ("a free integrator", "slow disturbance in the noise", "one state more")
    moves = [m for m in all_moves() if m.name in stuck and m.applies(at)]
    assert {m.name for m in moves} == set(stuck)
    assert all(m.evidence(at) == 0 for m in moves)


@pytest.mark.parametrize("given", ["greybox", "simulator"])
def test_what_the_user_gave_is_tried_before_any_other_model(given: str) -> None:
    known = simulation(physics=given == "greybox")
    if given == "simulator":
        plant = Plant(source="p.py:step", parameters={"k": Unknown(min=0.1, max=1.0)}, code=b"")
        known = replace(known, plant=plant)
    settings = ("order", None), ("delay", 0), ("periodic", False), ("regularised", "equation")
    known = replace(known, linear=settings)
    usual = family("linear")
    assert usual is not None
    baseline = Proposal(usual.trial(known).source(""), "baseline", "baseline", "", "")
    # Evidence for a static function, and a much better linear model.
    first = replace(trial(baseline, 1, 0.3), diagnoses=(("amplitude", 0.15),))
    proposal = AGENT().propose(replace(view(known, (first,), "explore"), linear=0.2))
    assert proposal is not None
    assert proposal.family == given


def test_equations_with_a_magnitude_need_no_sensor_without_sign() -> None:
    known = simulation(physics=True)
    assert known.physics is not None
    positive = Trajectory(known.records[0].u, abs(known.records[0].y), 1.0)
    says = replace(known, records=(positive,), description="The sensor gives the magnitude.")
    first = trial(following(says, (), "explore"), 1, 0.3)
    name, state = says.outputs[0].name, known.physics.states[-1]
    for observed, found in ((state, True), (f"abs({state})", False)):
        physics = replace(known.physics, observation={name: observed})
        facts = replace(says, physics=physics)
        grey = replace(
            first,
            family="greybox",
            source=Recipe("greybox", (), "LevenbergMarquardt", ()).source(""),
        )
        assert ("sign" in dict(diagnoses(view(facts, (grey,), "explore")))) == found


@pytest.mark.parametrize(("turns", "lost"), [("sharp", 0.5), ("smooth", 0.0), ("negative", 0.0)])
def test_an_output_that_bounces_off_zero_has_lost_its_sign(turns: str, lost: float) -> None:
    known = simulation(physics=False)
    wave = np.sin(0.05 * np.arange(2_000.0) + 0.3)[:, None]
    y = {"sharp": abs(wave), "smooth": 1.0 + wave, "negative": wave}[turns]
    noisy = y + 1e-4 * np.random.default_rng(0).normal(size=y.shape)
    record = Trajectory(
        np.ones((2_000, len(known.inputs))), np.tile(noisy, len(known.outputs)), 1.0
    )
    assert sign_lost(replace(known, records=(record,))) == lost


def test_a_sensor_without_sign_is_tried_where_the_description_says_so() -> None:
    known = simulation(physics=False)
    positive = Trajectory(known.records[0].u, abs(known.records[0].y), 1.0)
    says = replace(known, records=(positive,), description="The sensor gives the magnitude.")
    first = trial(following(says, (), "explore"), 1, 0.3)
    proposal = following(says, (first,), "explore")
    assert proposal.title.endswith("sensor without sign")
    better = replace(trial(proposal, 2, 0.1), status="keep")
    assert 'output_map="magnitude"' in following(says, (first, better), "explore").source
    slightly = replace(better, value=0.25)
    assert "output_map" not in following(says, (first, slightly), "explore").source
    signed = replace(says, records=known.records)
    other = following(signed, (trial(following(signed, (), "explore"), 1, 0.3),), "explore")
    assert "output_map" not in other.source


@pytest.mark.parametrize(
    ("maps", "inside"),
    [
        ({"input_map": "monotone"}, True),
        ({"input_map": "saturation"}, True),
        ({"output_map": "magnitude"}, False),
    ],
)
def test_a_family_that_has_the_leading_function_inside_begins_without(
    maps: dict[str, str], inside: bool
) -> None:
    known = simulation(physics=False)
    recipe = next(row for row in families(known) if row.name == "linear").trial(known)
    sources = [recipe.source("Plain."), recipe.mapped(**maps).source("Mapped.")]
    plain, mapped = (Proposal(source, "linear", "linear", "", "") for source in sources)
    leads = replace(trial(mapped, 2, 0.1), status="keep")
    made = agent.untried(view(known, (trial(plain, 1, 0.3), leads), "explore"))
    sources = {option.family: first.source for option in made if (first := option.make())}
    (name,) = maps
    assert (name in sources["nl_lfr"]) != inside
    assert name in sources["neural_ss"]


def test_a_biased_grey_box_gets_an_offset_before_other_things() -> None:
    known = simulation(physics=True)
    trials = climb(known, {"greybox": 0.3})
    first = replace(trials[0], diagnostics=(replace(CLEAN, bias=0.2),))
    assert following(known, (first, *trials[1:])).title == "grey-box: output offset"


def test_overfit_and_plateau_are_read_from_the_training_side() -> None:
    known = simulation(physics=False)
    one = next(t for t in climb(known, {"linear": 0.4}) if t.family == "linear")
    assert overfit(one) == 4.0
    y = np.minimum(np.sin(np.arange(400) / 20), 0.5)
    flat = replace(known, records=(Trajectory(y, y, 1.0),))
    assert plateau_share(flat.records) > 0.2
    assert plateau_share(known.records) < 0.02


def test_after_a_linear_model_the_most_apt_family_is_next_and_not_the_cheapest() -> None:
    known = simulation(physics=False)
    usual = family("linear")
    assert usual is not None
    baseline = Proposal(usual.trial(known).source(""), "baseline", "baseline", "", "")
    ladder = [row for row in families(known) if row.name != "linear"]
    seconds = [row.seconds(known, row.trial(known)) for row in ladder]
    assert seconds[0] > 10 * min(seconds)
    assert following(known, (trial(baseline, 1, 0.2),), "explore").family == ladder[0].name


def steps(recipe: Recipe) -> float:
    return recipe.number("steps", 0)


def test_a_long_fit_is_for_families_that_are_carried_on() -> None:
    known = windows()
    values = {"autoregressive": 0.30, "recurrent": 0.31}
    trials = climb(known, values)
    trials = tuple(replace(t, folds=(0.29, 0.33)) if t.family == "recurrent" else t for t in trials)
    short = {t.family: steps(recipe_of(t)) for t in trials}
    promoted: list[str] = []
    for number in range(len(trials) + 1, len(trials) + 8):
        proposal = following(known, trials)
        if proposal.title.endswith(": fitted in full"):
            promoted.append(proposal.family)
            assert steps(recipe_of(proposal)) > 2 * short[proposal.family]
            # The trial's own settings stay.
            cheap = next(t for t in trials if t.family == proposal.family)
            assert recipe_of(proposal).config == recipe_of(cheap).config
        trials = (*trials, trial(proposal, number, values.get(proposal.family, 0.9) + 0.01))
    assert promoted == ["autoregressive", "recurrent"]


@pytest.mark.slow
@pytest.mark.parametrize("known", [simulation(physics=False), windows()])
def test_validation_mode_stops_every_gradient_method_by_the_held_out_part(known: Facts) -> None:
    known = replace(known, early_stopping="validation")
    seen: set[str] = set()
    for done in search(AGENT, known, 40):
        recipe = recipe_of(done)
        if recipe.method in ("Adam", "LBFGS", "MultipleShooting"):
            seen.add(recipe.method)
            assert recipe.get("stop") == "validation", done.title
            assert not recipe.get("holdout")
    assert "Adam" in seen
    inner = search(AGENT, replace(known, early_stopping="inner"), 40)
    assert all(recipe_of(t).get("stop") is None for t in inner)


def test_a_family_that_ran_out_of_time_gets_a_second_chance() -> None:
    known = simulation(physics=False)
    trials = tuple(
        replace(t, value=None, folds=(), diagnostics=(), status="timeout")
        if t.family == "ltc"
        else t
        for t in climb(known, {"linear": 0.06}, rest=0.15)
    )
    proposal = following(known, trials)
    assert proposal.title == "LTC network: a shorter fit"
    first = next(t for t in trials if t.family == "ltc")
    assert steps(recipe_of(proposal)) < 0.5 * steps(recipe_of(first))


@pytest.mark.long
@pytest.mark.parametrize(
    "known",
    [simulation(physics=True), simulation(physics=False, samples=50_000), windows(), body()],
    ids=["physics", "long", "windows", "body"],
)
def test_sixty_proposals_are_sixty_configurations(known: Facts) -> None:
    trials = search(AGENT, known, 60)
    assert len(trials) == 60
    assert len({recipe_of(t).key for t in trials}) == 60
    assert any(t.value is None for t in trials)


@pytest.mark.slow
@pytest.mark.parametrize("known", [simulation(physics=True), simulation(physics=False), windows()])
def test_no_two_proposals_have_the_same_title(known: Facts) -> None:
    def better_each_time(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, 0.9 / number)

    titles = [t.title for t in search(AGENT, known, 40, better_each_time)]
    assert len(set(titles)) == len(titles)
    assert all(len(title) <= 80 for title in titles)
    repeated = [t for t in titles if plain_title(t) != t]
    # With equations there are moves enough for forty titles.
    assert repeated or known.physics is not None
    assert all(plain_title(t) in titles for t in repeated)


def test_a_repeated_title_says_which_settings_change() -> None:
    known = simulation(physics=False)
    seen = (*climb(known, {"linear": 0.3}),)
    best = next(t for t in seen if t.family == "linear")
    row = family("linear")
    assert row is not None
    more = next(m for m in all_moves() if m.name == "one state more")
    first = "linear state-space: one state more"
    for title, expected in (("other", first), (first, f"{first} (order 3 to 4)")):
        shown = view(known, (replace(best, title=title),), "refine")
        recipe = recipe_of(best).configured(order=3)
        at = Situation(shown, best, recipe, row, 0)
        assert title_of(at, more, more.change(at)) == expected


def test_one_state_more_is_more_than_the_fit_chose() -> None:
    known = simulation(physics=False)
    first, *_ = best_linear(known)
    row = family("neural_ss")
    assert row is not None
    seen = view(known, (replace(first, order=4),), "refine")
    more = next(m for m in all_moves() if m.name == "one state more")
    for own, expected in ((None, 5), (2, 3)):
        at = Situation(seen, replace(first, order=own), row.trial(known), row, 0)
        assert more.change(at).get("order") == expected


@pytest.mark.parametrize(
    ("whiteness", "value", "tries", "ends"),
    [(0.1, 0.1, 1, True), (0.1, 0.1, 0, False), (0.6, 0.1, 1, False), (0.1, 0.12, 1, False)],
    ids=["floor", "too early", "coloured", "above training"],
)
def test_the_search_ends_at_the_noise_floor_and_nowhere_else(
    whiteness: float, value: float, tries: int, ends: bool
) -> None:
    known = simulation(physics=False)
    left = replace(CLEAN, whiteness=whiteness)
    families_tried = climb(known, {}, rest=0.3)[: tries + 1]
    trials = (replace(families_tried[0], value=value, diagnostics=(left, left)),)
    trials = (*trials, *families_tried[1:])
    if not ends:
        following(known, trials)
        return
    with pytest.raises(AgentStoppedError, match="noise floor") as end:
        following(known, trials)
    assert end.value.reason == "saturated"


@pytest.mark.parametrize("leader", ["recurrent"])
def test_models_without_equations_get_the_symmetries_of_their_signals(leader: str) -> None:
    plain = simulation(physics=False)
    odd = replace(plain, symmetry={"odd": {"u": "-u", "y": "-y"}})
    inner = replace(plain, symmetry={"odd": {"u": "-u", "torque": "-torque"}})

    def outcome(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, 0.3 if proposal.family == leader else 0.9)

    def given(known: Facts) -> set[str]:
        done = search(ExpertAgent, known, 24, outcome)
        return {t.family for t in done if recipe_of(t).get("symmetry")}

    assert leader in given(odd)
    assert not given(inner)


def test_coloured_residuals_get_segments_then_polynomials() -> None:
    known = simulation(physics=False)
    trials = climb(known, {"neural_ss": 0.3})
    # The other families have had their refinement.
    trials = (*trials, *(t for t in trials if t.family != "neural_ss"))
    left = replace(CLEAN, whiteness=0.9)
    trials = tuple(
        replace(t, diagnostics=(left, left)) if t.family == "neural_ss" else t for t in trials
    )
    pieces = following(known, trials)
    assert pieces.title == "neural state-space: fit from pieces"
    tried = (*trials, trial(pieces, len(trials) + 1, 0.2, left))
    smooth = following(known, tried)
    assert smooth.title == "neural state-space: polynomials"
    assert recipe_of(smooth).get("degree") == 3
    assert recipe_of(smooth).get("pieces")


def no_better_than_the_mean(proposal: Proposal, number: int) -> Trial:
    return trial(proposal, number, 1.02 + 0.001 * number)


def remarks(known: Facts, experiments: int = 15) -> tuple[list[str], tuple[Trial, ...]]:
    """Collect the expert's remark with each proposal of a search in which no candidate beats the
    mean."""
    said: list[str] = []

    class Listening(ExpertAgent):
        def propose(self, view: AgentView) -> Proposal | None:
            proposal = super().propose(view)
            said.append(proposal.remark if proposal is not None else "")
            return proposal

    return said, search(Listening, known, experiments, no_better_than_the_mean)


def facts_of(u: Array, y: Array) -> Facts:
    return replace(simulation(physics=False), records=(Trajectory(u, y, 1.0),))


def in_loop(pole: float) -> Facts:
    return replace(simulation(physics=False), records=tuple(closed_loop(pole, 0.5)))


def test_while_nothing_beats_the_mean_the_expert_tries_other_kinds_and_varies_none() -> None:
    rng = np.random.default_rng(0)
    known = facts_of(rng.standard_normal(1000), lagged(rng.standard_normal(1000), 1))
    said, trials = remarks(known)
    assert said[:3] == ["", "", ""]
    assert all("no candidate beats the mean" in words for words in said[3:])
    assert "no input" in said[-1]
    names = {move.name for move in COURSE_MOVES}
    refined = [t.title.partition(": ")[2] for t in trials if t.parent is not None]
    assert {plain_title(f": {name}")[2:] for name in refined} <= names
    assert len({t.family for t in trials}) >= 8
    assert not any("other" in words for words in remarks(simulation(physics=False), 3)[0])


def test_the_expert_explains_why_no_candidate_beats_the_mean() -> None:
    said, _ = remarks(in_loop(1.05), 5)
    assert "the plant is unstable" in said[-1]
    assert "inputs follow the past outputs" in said[-1]
    assert 'kind = "windows"' in said[-1]
    said, _ = remarks(in_loop(0.9), 5)
    assert "closed loop" in said[-1]
    said, _ = remarks(replace(in_loop(0.9), horizon=40), 5)
    assert "Shorter windows than 40 samples" in said[-1]


def test_a_delay_beyond_the_search_range_of_families_is_set_at_once() -> None:
    u = np.repeat(np.random.default_rng(4).uniform(-1, 1, 200), 5)
    known = facts_of(u, lagged(u, 30))
    first = following(known, (), "explore")
    second = following(known, (trial(first, 1, 0.8),), "explore")
    assert second.title == f"{first.title}: inputs that act after 30 samples"
    assert recipe_of(second).get("delay") == 29


def test_without_further_moves_beyond_the_mean_the_search_ends_with_the_reason() -> None:
    rng = np.random.default_rng(0)
    known = facts_of(rng.standard_normal(1000), lagged(rng.standard_normal(1000), 1))
    with pytest.raises(AgentStoppedError, match="no candidate beats the mean") as end:
        search(AGENT, known, 200, no_better_than_the_mean)
    assert end.value.reason == "exhausted"


def test_families_that_cannot_add_up_are_not_refined_where_the_output_drifts() -> None:
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 200), 5)
    known = facts_of(u, np.cumsum(u) + 0.01 * rng.standard_normal(1000))
    doubtful = {row.name for row in families(known) if row.doubtful(known)}
    assert {"block_oriented", "ltc"} <= doubtful
    assert not {"linear", "neural_ss", "subnet", "narx"} & doubtful
    assert not any(row.doubtful(simulation(physics=False)) for row in families(known))

    def near(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, 0.29 if proposal.family in doubtful else 0.3)

    def behind(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, 0.3 if proposal.family in doubtful else 0.29)

    refined = {t.family for t in search(AGENT, known, 40, behind) if t.parent is not None}
    assert refined
    assert not refined & doubtful
    # Evidence that is wrong is given up: a family that leads is refined.
    assert {t.family for t in search(AGENT, known, 40, near) if t.parent is not None} & doubtful


def test_a_trace_of_switching_brings_its_elements_before_polynomials(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known, left = simulation(physics=False), replace(CLEAN, whiteness=0.9)

    def coloured_always(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, 0.3 if proposal.family == "neural_ss" else 0.9, left)

    def titles(share: float) -> list[str]:
        found = Switching(share, "displacement", 0)
        monkeypatch.setattr(neural_ss, "switching", lambda facts: found)
        return [t.title for t in search(AGENT, known, 15, coloured_always)]

    first = ["fit from pieces", "a trace of friction", "a trace of play", "polynomials"]
    places = [titles(0.1).index(f"neural state-space: {name}") for name in first]
    assert places == sorted(places)
    smooth = titles(0.001)
    last = smooth.index("neural state-space: polynomials")
    assert "neural state-space: a trace of friction" not in smooth[:last]


@pytest.mark.parametrize(("over", "ends"), [(1.02, True), (1.2, False)])
def test_the_noise_between_periods_ends_the_search(over: float, ends: bool) -> None:
    rng = np.random.default_rng(8)
    u = np.tile(rng.standard_normal(250), 4)
    y = lagged(u, 1) + 0.1 * rng.standard_normal(1000)
    known = facts_of(u, y)
    floor = noise_of_periods(known.records)
    assert floor == pytest.approx(0.1 / y.std(), rel=0.1)
    left = replace(CLEAN, whiteness=0.9)
    tried = climb(known, {}, rest=0.3)[:4]
    first = replace(tried[0], value=over * float(floor or 0.0), diagnostics=(left, left))
    if not ends:
        following(known, (first, *tried[1:]))
        return
    with pytest.raises(AgentStoppedError, match="between the periods"):
        following(known, (first, *tried[1:]))
