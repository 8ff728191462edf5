"""Choice of open settings inside the training records, the same for all folds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.agents import AgentView, Proposal
from asia.agents.library.registry import all_families, family
from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import Reason
from asia.interfaces.cli.show import describe, wide_console
from asia.judge.evaluation.evaluator import EvaluationData
from asia.judge.evaluation.references import LINEAR
from asia.ledger.events import Variant
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.physics import ParameterRange, Physics
from asia.problem.physics_text import written_physics
from asia.problem.protocol import EarlyStopping, FoldRule, ProtocolRule
from asia.recipe import Recipe, read_recipe
from asia.search.fair_trial import (
    PROPOSED,
    Tried,
    chosen_of,
    compared,
    finer_path,
    variants_between,
    variants_of,
    with_inputs_of,
)
from asia.search.replay import replay_run
from asia.search.run import prepare, search
from asia.search.simulation import simulated_excerpts

from .toy import arx, search_toy, write_problem

LM = "LevenbergMarquardt", (("iterations", 5), ("starts", 1))
BEGUN = {"linear": LINEAR}
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, 2, 2)
OPEN = Recipe("neural_ss", (("hidden", 2),), *LM)


def test_variants_go_from_the_linear_model_to_the_freest_setting() -> None:
    found = variants_of(OPEN.source(""), BEGUN)
    assert list(found) == ["linear", "ridge 0.1", "ridge 0.001", "ridge 1e-05"]
    assert found["linear"] == LINEAR
    recipe = read_recipe(found["ridge 0.001"])
    assert recipe is not None
    assert recipe.key == OPEN.configured(ridge=1e-3).key


@pytest.mark.parametrize(
    "source",
    [OPEN.configured(ridge=1e-4).source(""), LINEAR, arx(2), "def fit(:", "x = 1\n"],
)
def test_what_is_stated_or_not_of_the_library_stays(source: str) -> None:
    assert variants_of(source, BEGUN) == {}


def test_a_model_built_on_equations_is_not_exchanged_for_a_linear_one() -> None:
    row = family("hybrid")
    assert row is not None
    assert row.kind == "equations"
    assert "linear" not in variants_of(Recipe("hybrid", (("units", 4),), *LM).source(""), BEGUN)


def test_a_fair_trial_of_any_other_model_is_against_the_linear_one() -> None:
    network = Recipe("ltc", (("units", 4),), "Adam", (("steps", 10),)).source("")
    assert variants_of(network, BEGUN, fair=True) == {"linear": LINEAR, PROPOSED: network}
    assert variants_of(network, {}, fair=True) == {}
    for source in (LINEAR, arx(2), Recipe("greybox", (), *LM).source("")):
        assert variants_of(source, BEGUN, fair=True) == {}


def test_inputs_between_samples_are_open_until_someone_states_them() -> None:
    u = np.random.default_rng(0).normal(size=(60, 1))
    record = Trajectory(u, u, 1.0, "r")
    stairs = replace(record, u=np.repeat(u[:20], 3, axis=0))

    def kinds(recipe: Recipe, record: Trajectory = record, **given: Any) -> list[Any]:
        context = replace(CONTEXT, inputs=(Signal("u", **given),))
        data = cast(Any, SimpleNamespace(context=context, records=(record,)))
        found = variants_between(recipe.source(""), data)
        read = [read_recipe(source) for source in found.values()]
        return [one.get("intersample") for one in read if one is not None]

    plain = Recipe("greybox", (), *LM)
    for name in ("greybox", "hybrid", "simulator", "compartments"):
        assert kinds(replace(plain, family=name)) == ["zero", "first", "band_limited"]
    assert kinds(replace(plain, family="linear")) == []
    assert kinds(plain.configured(intersample="first")) == []
    assert kinds(plain, intersample="zero") == []
    assert kinds(plain, stairs) == []
    assert kinds(plain, role="time_step") == []


def test_equations_that_delay_a_signal_keep_their_inputs_held() -> None:
    u = np.random.default_rng(0).normal(size=(60, 1))
    records = (Trajectory(u, u, 1.0, "r"),)
    plain, parent = Recipe("greybox", (), *LM), Recipe("greybox", (("intersample", "first"),), *LM)
    for term, count in (("u", 3), ("lag(u, 2)", 3), ("delay(u, 2)", 0), ("plug_flow(u, 1, k)", 0)):
        physics = Physics(("y",), {"y": f"{term} - k*y"}, {"k": ParameterRange(0.1, 1.0)})
        context = replace(CONTEXT, physics=physics)
        own = plain.configured(physics=(written_physics(physics),))
        for recipe, where in ((plain, context), (own, CONTEXT), (own, context)):
            data = cast(Any, SimpleNamespace(context=where, records=records))
            source = recipe.source("")
            assert len(variants_between(source, data)) == count
            assert (with_inputs_of(source, parent.source(""), where) == source) == (count == 0)
        compartments = cast(Any, SimpleNamespace(context=context, records=records))
        source = Recipe("compartments", (), *LM).source("")
        assert len(variants_between(source, compartments)) == 3


def test_a_child_has_the_inputs_of_its_parent_between_samples() -> None:
    parent = Recipe("greybox", (("intersample", "first"),), *LM).source("")
    child = Recipe("hybrid", (("units", 2),), *LM)
    found = read_recipe(with_inputs_of(child.source(""), parent, CONTEXT))
    assert found is not None
    assert found.key == child.configured(intersample="first").key
    for source in (child.configured(intersample="zero").source(""), LINEAR, "x = 1\n"):
        assert with_inputs_of(source, parent, CONTEXT) == source
    assert with_inputs_of(child.source(""), LINEAR, CONTEXT) == child.source("")


@pytest.mark.parametrize(
    ("samples", "stopping", "count"), [(300, "inner", 3), (300, "validation", 0), (40, "inner", 0)]
)
def test_inner_folds_are_there_where_they_can_be_used(
    samples: int, stopping: EarlyStopping, count: int
) -> None:
    rng = np.random.default_rng(0)
    record = Trajectory(rng.normal(size=samples), rng.normal(size=samples), 1.0, "r")
    rule = ProtocolRule(
        folds=FoldRule(count=2), past_inputs=4, past_outputs=4, horizon=10, early_stopping=stopping
    )
    folds = make_folds([record], rule)
    data = EvaluationData(folds, (record,), cast(Any, None), rule)
    assert len(data.inner_folds) == count


def test_paths_go_from_stiff_to_free() -> None:
    paths = [row.path.values for row in all_families() if row.path is not None]
    assert paths
    assert all(list(values) == sorted(values, reverse=True) for values in paths)


@given(st.integers(0, 10_000), st.sampled_from(["linear", "its parent", "ridge 1"]))
def test_the_least_error_is_chosen_unless_what_it_begins_with_is_as_good(
    seed: int, begin: str
) -> None:
    rng = np.random.default_rng(seed)
    errors = [tuple(rng.uniform(0.5, 1.5, 24)) for _ in range(4)]
    first, *changes = found = chosen_of([begin, "ridge 0.1", "ridge 0.01", "ridge 1e-3"], errors)
    assert sum(one.chosen for one in found) == 1
    assert min(one.behind for one in found) == 0.0
    least = min(changes, key=lambda one: one.behind)
    if begin == "linear":
        assert first.chosen == (first.behind <= first.deviation)
        assert least.chosen or first.chosen
    elif begin == "its parent":
        assert first.chosen == (least.behind > least.deviation)
        assert least.chosen or first.chosen
    else:
        assert min(found, key=lambda one: one.behind).chosen


def test_a_variant_that_diverges_in_one_part_is_not_taken_for_equal() -> None:
    rng = np.random.default_rng(0)
    best = 0.1 + 0.01 * rng.random(24)
    lost = best - 1e-4
    lost[3] = 50.0
    found = chosen_of(["linear", "ridge 0.1"], [tuple(lost), tuple(best)])
    assert [one.chosen for one in found] == [False, True]


def test_a_failed_variant_is_never_chosen() -> None:
    found = chosen_of(["linear", "ridge 0.1"], [Reason.FIT_TIMEOUT, (2.0, 3.0)])
    assert [one.chosen for one in found] == [False, True]
    assert found[0].error is None
    assert Tried("", cast(Any, None), found).late
    assert not Tried("", cast(Any, None), found[1:]).late
    assert chosen_of(["linear"], [Reason.CRASH]) == ()


@pytest.mark.parametrize(
    ("errors", "tried", "chosen"),
    [
        ((1.0, 2.0, 3.0, 0.1), 3, "linear"),
        ((1.0, 2.0, 0.5, 0.6), 4, "ridge 0.001"),
        ((1.0, None, 0.9, None), 4, "ridge 0.001"),
        ((None, None, None, 1.0), 3, None),
    ],
)
def test_a_path_ends_where_the_error_rose_twice(
    errors: Sequence[float | None], tried: int, chosen: str | None
) -> None:
    sources = variants_of(OPEN.source(""), BEGUN)
    known = dict(zip(sources.values(), errors, strict=True))

    def inner_errors(source: str) -> tuple[float, ...] | Reason:
        error = known[source]
        return Reason.NOT_FINITE if error is None else (error, 1.01 * error)

    found = compared(cast(Any, SimpleNamespace(inner_errors=inner_errors)), sources)
    assert len(found) == (tried if chosen else 0)
    assert [one.name for one in found if one.chosen] == ([chosen] if chosen else [])


@pytest.mark.slow
def test_a_search_scores_the_variant_it_names(tmp_path: Path) -> None:
    # The third is what the second one chooses.
    stated = variants_of(OPEN.source(""), {}, values=(1e-3,))["ridge 0.001"]
    directory = search_toy(tmp_path, OPEN.source(""), stated)
    run = open_run(directory)
    _, opened, fixed = run.view.experiments
    assert opened.result is not None
    assert fixed.result is not None
    (chosen,) = (one.name for one in opened.result.variants if one.chosen)
    assert opened.result.variants[0].name == "linear"
    recipe = read_recipe(run.store.text(opened.source))
    assert recipe is not None
    assert chosen == f"ridge {recipe.get('ridge'):g}"
    assert run.store.text(opened.proposed.source) == OPEN.source("")
    assert fixed.result.variants == ()
    assert fixed.source == fixed.proposed.source
    console = wide_console()
    with console.capture() as shown:
        describe(console, run, opened)
    assert "  linear       " in shown.get()
    assert "<- scored" in shown.get()
    # A stack has no model twice.
    assert opened.source == fixed.source
    assert opened.score == fixed.score
    assert run.view.refitted is not None
    stack = run.view.refitted.stack
    assert stack is None or not {2, 3} <= {member.experiment for member in stack.members}
    # All that is made of an experiment is made of the source that was scored.
    verify(directory)
    assert simulated_excerpts(run, opened.number) is not None
    assert replay_run(directory, lambda item: None).agrees


@dataclass(frozen=True)
class Refining:
    """Proposes a model, then changes to it that are compared with it."""

    changes: tuple[str, ...]
    name: str = "refining"

    def propose(self, view: AgentView) -> Proposal | None:
        index = len(view.trials) - 1
        parent = None if index == 0 else 2
        if index == len(self.changes):
            return None
        source = self.changes[index]
        return Proposal(source, "x", f"number {index}", "", "", parent=parent, fair=True)


@pytest.mark.long
def test_a_move_that_gains_nothing_ends_in_its_parent_without_a_fit(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=3)
    stated = Recipe("neural_ss", (("hidden", 2), ("ridge", 1e-3)), *LM)
    sources = stated.source(""), stated.configured(ridge=1e5).source("")
    ready = prepare(load_problem(problem), "refining", seed=0, runs=tmp_path / "runs")
    search(ready, Refining(sources), lambda event, view: None, lambda view: None)
    run = open_run(ready.directory)
    _, parent, move = run.view.experiments
    assert move.result is not None
    assert parent.result is not None
    assert [(one.name, one.chosen) for one in move.result.variants] == [
        ("its parent", True),
        (PROPOSED, False),
    ]
    assert move.source == parent.source
    assert move.score == parent.score
    assert move.result.folds == parent.result.folds
    verify(ready.directory)
    assert replay_run(ready.directory, lambda item: None).agrees


def test_a_path_gets_the_value_between_its_best_ones() -> None:
    errors = {"linear": 0.43, "ridge 0.1": 0.127, "ridge 0.001": 0.098, "ridge 1e-05": 0.16}
    variants = [Variant(name, error) for name, error in errors.items()]
    assert finer_path(OPEN.source(""), variants) == (0.1, 0.01, 1e-3, 1e-5)
    assert finer_path(OPEN.source(""), variants[:2]) == (0.1,)
    assert finer_path(OPEN.source(""), [variants[0], *variants[2:]]) == (1e-3, 1e-4, 1e-5)
