"""Families of the library are not suspected, even when they are hardly fitted: linear, polynomial,
and in single precision recurrent."""

import types

import pytest

from asia.agents.library.registry import all_families
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule
from asia.testing.family import family_problem, smallest_source
from tests.unit.judge.evaluation.relations import Stepping, suspicions_of

CHOSEN = {"linear", "narx", "recurrent"}


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(r, id=r.name, marks=pytest.mark.slow if r.kind == "network" else ())
        for r in all_families()
        if r.name in CHOSEN
    ],
)
def test_a_family_is_not_suspected(row):
    record, context = family_problem(row)
    rule = ProtocolRule(past_inputs=5, past_outputs=5)
    held = make_folds([record], rule)[1]
    module = types.ModuleType(row.name)
    exec(smallest_source(row, record, context), module.__dict__)
    model = Stepping(module.fit(held.train, context))
    assert suspicions_of(model, held.held_out, held.scale, None) == ()
