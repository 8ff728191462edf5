"""Windows: where they lie, and which of them each fold trains on and holds out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Trajectory
from asia.errors import UserError
from asia.problem.folds import make_folds, whole
from asia.problem.protocol import FoldRule, Group, ProtocolRule

RULE = ProtocolRule(kind="windows", horizon=50, past_inputs=0, past_outputs=1, metric="mae")


def record(length: int, name: str) -> Trajectory:
    """Two outputs that differ at every sample, the first being the sample's number."""
    t = np.arange(length, dtype=float)
    return Trajectory(t[:, None], np.stack([t, (t % 7) ** 2], axis=1), 0.01, name)


def grouped(*groups: tuple[str, ...]) -> ProtocolRule:
    named = tuple(Group(f"g{i}", records) for i, records in enumerate(groups))
    return replace(RULE, folds=FoldRule("leave_one_group_out", len(named), named))


@given(
    length=st.integers(2, 400),
    horizon=st.integers(1, 60),
    past_inputs=st.integers(0, 5),
    past_outputs=st.integers(0, 5),
)
def test_laws_of_windows(length: int, horizon: int, past_inputs: int, past_outputs: int) -> None:
    rule = replace(RULE, horizon=horizon, past_inputs=past_inputs, past_outputs=past_outputs)
    measured = record(length, "r")
    found = whole([measured], rule)
    if length < rule.past + horizon:
        assert found == ()
        return
    assert len(found) == -(-(length - rule.past) // horizon)
    assert [b.start for b in found[:-1]] == [rule.past + horizon * i for i in range(len(found) - 1)]
    assert found[-1].stop == length
    assert {k for b in found for k in range(b.start, b.stop)} == set(range(rule.past, length))
    for block in found:
        assert block.y.shape == (horizon, 2)
        assert np.array_equal(block.y[:, 0], np.arange(block.start, block.stop))
        assert np.array_equal(block.u[:, 0], block.y[:, 0])
        before = np.arange(block.start - past_outputs, block.start)
        assert np.array_equal(block.past_y[:, 0], before)
        assert block.past_u.shape == (past_inputs, 1)


def test_runs_of_the_nanodrone_give_the_windows_of_the_paper() -> None:
    for length, windows in ((6000, 120), (5999, 120), (1900, 38), (6499, 130)):
        assert len(whole([record(length, "r")], RULE)) == windows


def test_one_group_is_held_out_and_the_others_train_whole() -> None:
    records = [record(120, "a1"), record(95, "b1"), record(151, "a2"), record(70, "c1")]
    folds = make_folds(records, grouped(("a1", "a2"), ("b1",), ("c1",)))
    assert [[t.name for t in fold.train] for fold in folds] == [
        ["b1", "c1"],
        ["a1", "a2", "c1"],
        ["a1", "b1", "a2"],
    ]
    assert [len(t) for t in folds[0].train] == [95, 70]
    assert [b.record for b in folds[0].held_out] == [0, 0, 0, 2, 2, 2]
    assert [b.start for b in folds[0].held_out] == [1, 51, 70, 1, 51, 101]
    trained = np.concatenate([b.y for b in whole(folds[0].train, RULE)])
    assert len(trained) == 50 * (2 + 2)
    assert np.array_equal(folds[0].scale, trained.std(axis=0))


def test_groups_go_with_long_simulation_too() -> None:
    rule = replace(grouped(("a",), ("b",)), kind="simulation", horizon=None)
    first, _ = make_folds([record(30, "a"), record(20, "b")], rule)
    assert [(b.start, b.stop) for b in first.held_out] == [(1, 30)]
    assert np.array_equal(first.scale, record(20, "b").y.std(axis=0))


@given(length=st.integers(60, 200), count=st.integers(2, 3), past=st.integers(0, 3))
def test_contiguous_folds_are_cut_into_windows(length: int, count: int, past: int) -> None:
    rule = replace(
        RULE, horizon=8, past_inputs=past, past_outputs=past, folds=FoldRule(count=count)
    )
    seen: set[int] = set()
    for fold in make_folds([record(length, "r")], rule):
        held = {k for b in fold.held_out for k in range(b.start, b.stop)}
        assert not seen & held
        seen |= held
        assert not held & {int(k) for t in fold.train for k in t.u[:, 0]}
        assert all(len(t) >= past + 8 for t in fold.train)
    assert seen == set(range(past, length))


def test_a_record_shorter_than_a_window_is_refused() -> None:
    with pytest.raises(UserError, match="record 'b': 40 samples are too few"):
        make_folds([record(120, "a"), record(40, "b")], grouped(("a",), ("b",)))
