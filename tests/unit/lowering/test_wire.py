"""A lowered model as bytes: read strictly, whatever they are."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.lowering.evaluation import simulate
from asia.lowering.program import Builder, LoweredModel, ShapeError
from asia.lowering.wire import MAGIC, REFUSED, FormatError, pack, pack_refusal, unpack, unpack_for


def first_order() -> LoweredModel:
    """x' = 0.5 x + u, y = x + u, from the last past output."""
    start = Builder(((1, 1), (1, 1), (1,)))
    x = start.add("reshape", [1], (1,))
    step = Builder(((1,), (1,)))
    y = step.add("add", [0, 1])
    after = step.add("add", [step.add("mul", [0, step.constant(0.5)]), 1])
    return LoweredModel(1, 1, 1, 1, False, start.program([x]), step.program([y, after]))


def looped() -> LoweredModel:
    """The same, the sum made in a loop."""
    model = first_order()
    body = Builder(((1,), (1,)))
    inside = body.program([body.add("add", [0, 1])])
    step = Builder(((1,), (1,)))
    loop = step.add("loop", [0, step.add("reshape", [1], (1, 1))], (1, 0, 1), inside)
    y = step.add("part", [loop], (0,))
    after = step.add("add", [step.add("mul", [0, step.constant(0.5)]), 1])
    return LoweredModel(1, 1, 1, 1, False, model.initial, step.program([y, after]))


def called() -> LoweredModel:
    """The same, the sum made by a function with a name."""
    model = first_order()
    body = Builder(((1,), (1,)))
    total = body.add("label", [body.add("add", [0, 1])], tuple(b"total"))
    step = Builder(((1,), (1,)))
    call = step.add("call", [0, 1], tuple(b"sum x u"), body.program([total]))
    y = step.add("part", [call], (0,))
    after = step.add("add", [step.add("mul", [0, step.constant(0.5)]), 1])
    return LoweredModel(1, 1, 1, 1, False, model.initial, step.program([y, after]))


@pytest.mark.parametrize("names", [b"", b" ", b"a;b", b"sum x u more"])
def test_a_call_takes_names_of_letters_and_no_more_than_it_reads(names: bytes) -> None:
    body, step = Builder(((1,), (1,))), Builder(((1,), (1,)))
    with pytest.raises(ShapeError):
        step.add("call", [0, 1], tuple(names), body.program([0]))


@pytest.mark.parametrize("make", [first_order, looped, called])
def test_what_is_packed_comes_back(make) -> None:
    model = make()
    again = unpack(pack(model))
    assert isinstance(again, LoweredModel)
    u = np.array([[1.0], [2.0], [0.0]])
    expected = [[4.0], [4.5], [3.25 - 0.5]]
    expected[2] = [0.5 * (0.5 * 3.0 + 1.0) + 2.0]
    for one in (model, again):
        y = simulate(one, np.zeros((1, 1)), np.array([[3.0]]), u)
        np.testing.assert_allclose(y, expected)
    assert pack(again) == pack(model)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_are_a_whole_model(data: st.DataObject) -> None:
    raw = bytearray(pack(data.draw(st.sampled_from([looped, called]))()))
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(len(MAGIC), len(raw) - 1))
        raw[place] = data.draw(st.integers(0, 255))
    try:
        found = unpack(bytes(raw))
    except FormatError:
        return
    assert isinstance(found, LoweredModel)
    found.check()
    assert found.step.plain.output_shapes == found.step.output_shapes
    assert found.initial.plain.output_shapes == found.initial.output_shapes


@given(st.integers(0, 400))
def test_torn_bytes_are_refused(length: int) -> None:
    raw = pack(looped())
    if length < len(raw):
        with pytest.raises(FormatError):
            unpack(raw[:length])
    with pytest.raises(FormatError):
        unpack(raw + b"x")


def test_sizes_that_would_fill_the_memory_are_refused() -> None:
    raw = pack(first_order())
    huge = struct.pack("<I", 1) + struct.pack("<q", 1 << 60)
    place = raw.index(struct.pack("<I", 2) + struct.pack("<qq", 1, 1))
    with pytest.raises(FormatError):
        unpack(raw[:place] + huge + raw[place:])


def test_a_model_of_other_signals_is_refused() -> None:
    with pytest.raises(FormatError, match="other signals"):
        unpack_for(pack(first_order()), (1, 1, 2, 1))


def test_words_of_a_refusal_are_printable_and_short() -> None:
    assert unpack(pack_refusal("cannot: \x1b[31mred" + 1000 * "x")).startswith("cannot: _[31mred")
    assert len(unpack(REFUSED + 5000 * b"x")) == 600


def test_parts_that_do_not_fit_are_not_packed() -> None:
    model = first_order()
    with pytest.raises(ShapeError, match="other signals"):
        pack(LoweredModel(2, 1, 1, 1, False, model.initial, model.step))
    with pytest.raises(ShapeError, match="differ"):
        Builder(((2,), (3,))).add("add", [0, 1])


def test_output_and_update_hold_what_they_need_alone() -> None:
    model = first_order()
    assert [n.op for n in model.output.nodes] == ["add"]
    assert [n.op for n in model.update.nodes] == ["mul", "add"]
