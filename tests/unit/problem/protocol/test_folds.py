from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Trajectory
from asia.errors import UserError
from asia.problem.folds import inner_folds, make_folds, whole
from asia.problem.protocol import FoldRule, ProtocolRule


def record(length: int, name: str = "r") -> Trajectory:
    t = np.arange(length, dtype=float)
    return Trajectory(t[:, None], np.stack([t, t**2], axis=1), 1.0, name)


def test_cascaded_tanks_folds_are_those_of_the_paper() -> None:
    rule = ProtocolRule(folds=FoldRule(count=2), past_inputs=5, past_outputs=5)
    first, second = make_folds([record(1024)], rule)
    block = first.held_out[0]
    assert (block.start + 1, block.stop) == (6, 515)
    assert (second.held_out[0].start + 1, second.held_out[0].stop) == (516, 1024)
    assert first.train[0].u[0, 0] + 1 == 516
    assert (second.train[0].u[0, 0] + 1, len(second.train[0])) == (6, 510)
    assert np.array_equal(second.held_out[0].past_u[:, 0] + 1, [511, 512, 513, 514, 515])


@given(
    lengths=st.lists(st.integers(60, 90), min_size=1, max_size=3),
    count=st.integers(2, 4),
    past=st.integers(0, 4),
    gap=st.integers(0, 6),
)
def test_forward_folds_train_only_on_the_past(
    lengths: list[int], count: int, past: int, gap: int
) -> None:
    records = [record(n, str(i)) for i, n in enumerate(lengths)]
    rule = ProtocolRule(
        folds=FoldRule("forward", count, gap=gap or None), past_inputs=past, past_outputs=past
    )
    folds = make_folds(records, rule)
    assert len(folds) == count
    ends = dict.fromkeys(range(len(records)), 0)
    for fold in folds:
        assert not any(fold.followed)
        for block in fold.held_out:
            (trained,) = [t for t in fold.train if t.name == str(block.record)]
            assert trained.u[-1, 0] == block.start - gap - 1
            assert ends[block.record] in (0, block.start)
            ends[block.record] = block.stop
    assert list(ends.values()) == lengths


@given(length=st.integers(60, 90), count=st.integers(2, 4), gap=st.integers(1, 6))
def test_a_gap_next_to_a_held_out_block_trains_nothing(length: int, count: int, gap: int) -> None:
    rule = ProtocolRule(folds=FoldRule(count=count, gap=gap), past_inputs=2, past_outputs=2)
    plain = ProtocolRule(folds=FoldRule(count=count), past_inputs=2, past_outputs=2)
    folds = make_folds([record(length)], rule)
    for fold, same in zip(folds, make_folds([record(length)], plain), strict=True):
        (block,) = fold.held_out
        assert (block.start, block.stop) == (same.held_out[0].start, same.held_out[0].stop)
        trained = np.concatenate([t.u[:, 0] for t in fold.train])
        near = (trained >= block.start - gap) & (trained < block.stop + gap)
        assert not near.any()
        assert {block.start - gap - 1, block.stop + gap} & set(trained.astype(int).tolist())
        assert fold.followed == (block.stop < length,)


@given(
    lengths=st.lists(st.integers(40, 90), min_size=1, max_size=3),
    count=st.integers(2, 4),
    past=st.integers(0, 4),
)
def test_laws_of_contiguous_folds(lengths: list[int], count: int, past: int) -> None:
    records = [record(n, str(i)) for i, n in enumerate(lengths)]
    rule = ProtocolRule(folds=FoldRule(count=count), past_inputs=past, past_outputs=past)
    folds = make_folds(records, rule)
    seen: list[set[int]] = [set() for _ in records]
    for fold in folds:
        for block in fold.held_out:
            held = set(range(block.start, block.stop))
            assert not seen[block.record] & held
            seen[block.record] |= held
            measured = records[block.record]
            assert np.array_equal(block.y, measured.y[block.start : block.stop])
            assert np.array_equal(block.u, measured.u[block.start : block.stop])
            trained = [t for t in fold.train if t.name == measured.name]
            for part in trained:
                assert not held & {int(v) for v in part.u[:, 0]}
        assert np.allclose(fold.scale, np.concatenate([t.y for t in fold.train]).std(axis=0))
    for measured, covered in zip(records, seen, strict=True):
        assert covered == set(range(past, len(measured)))


def test_blocks_of_whole_records_start_after_the_past_window() -> None:
    rule = ProtocolRule(past_inputs=2, past_outputs=3)
    block = whole([record(10)], rule)[0]
    assert block.start == 3
    assert np.array_equal(block.past_u[:, 0], [1, 2])
    assert np.array_equal(block.past_y[:, 0], [0, 1, 2])


def test_a_constant_output_is_refused() -> None:
    flat = Trajectory(np.arange(50.0), np.ones(50), 1.0, "flat")
    with pytest.raises(UserError, match="output 1 is constant"):
        make_folds([flat], ProtocolRule(past_inputs=2, past_outputs=2))


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(UserError, match="too few"):
        make_folds([record(11)], ProtocolRule(past_inputs=10, past_outputs=10))


def test_an_output_that_hardly_moves_in_one_fold_is_refused() -> None:
    """The square of its deviation would underflow, and with it every error."""
    t = np.arange(60.0)
    y = np.where(t < 30, t, 1e-310 * t)[:, None]
    with pytest.raises(UserError, match="output 1 is constant over the training samples of fold 1"):
        make_folds([Trajectory(t, y, 1.0, "r")], ProtocolRule(past_inputs=0, past_outputs=0))


@given(length=st.integers(60, 90), count=st.integers(1, 4), gap=st.integers(0, 3))
def test_tail_folds_hold_out_the_end_of_each_record(length: int, count: int, gap: int) -> None:
    folds = FoldRule("tail", count, gap=gap or None, tail=20)
    rule = ProtocolRule(folds=folds, past_inputs=4, past_outputs=4)
    found = make_folds([record(length, "a"), record(length + 9, "b")], rule)
    assert len(found) == count
    for number, samples in enumerate((length, length + 9)):
        blocks = [fold.held_out[number] for fold in found]
        assert (blocks[0].start, blocks[-1].stop) == (samples - 20, samples)
        assert all(a.stop == b.start for a, b in pairwise(blocks))
        for fold, block in zip(found, blocks, strict=True):
            assert fold.train[number].u[0, 0] == 4
            assert fold.train[number].u[-1, 0] == block.start - gap - 1
            assert not any(fold.followed)


def test_folds_share_the_records_memory() -> None:
    rule = ProtocolRule(folds=FoldRule(count=2), past_inputs=4, past_outputs=4)
    whole_record = record(90)
    for fold in make_folds([whole_record], rule):
        for part in (*fold.train, fold.held_out[0]):
            assert np.shares_memory(part.u, whole_record.u)


@given(
    lengths=st.lists(st.integers(60, 90), min_size=1, max_size=7),
    count=st.integers(2, 5),
    past=st.integers(0, 4),
)
def test_inner_folds_divide_the_training_records_of_each_fold(
    lengths: list[int], count: int, past: int
) -> None:
    records = [
        Trajectory(1000.0 * i + r.u, r.y, 1.0, r.name)
        for i, r in enumerate(record(n, str(i)) for i, n in enumerate(lengths))
    ]
    rule = ProtocolRule(folds=FoldRule(count=count), past_inputs=past, past_outputs=past)
    folds = make_folds(records, rule)
    found = inner_folds(folds, rule)
    # All thirds are held out somewhere, and no fold is without one.
    assert len(found) == max(3, count)
    assert [one.index for one in found] == list(range(count, count + len(found)))
    for one in found:
        trained = {*np.concatenate([t.u[:, 0] for t in one.train])}
        held = {*np.concatenate([b.u[:, 0] for b in one.held_out])}
        assert not trained & held
        # They come from one fold, and not from what that holds out.
        own = [{*np.concatenate([t.u[:, 0] for t in fold.train])} for fold in folds]
        assert any(trained <= samples and held <= samples for samples in own)


def test_records_too_short_for_thirds_have_no_inner_folds() -> None:
    rule = ProtocolRule(folds=FoldRule(count=2), past_inputs=5, past_outputs=5, horizon=40)
    with pytest.raises(UserError):
        inner_folds(make_folds([record(200)], rule), rule)
