"""The [symmetry] tables: signed permutations of signals, and the group that they make."""

import numpy as np
import pytest

from asia.errors import UserError
from asia.problem.symmetry import Symmetry, check_symmetry, group, of_signals

TURN = {"x": "y", "y": "-x"}
MIRROR = {"y": "-y"}


def test_a_turn_and_a_mirror_make_the_eight_symmetries_of_a_square() -> None:
    found = group({"turn": TURN, "mirror": MIRROR}, ["x", "y"])
    assert found.shape == (8, 2, 2)
    np.testing.assert_array_equal(found[0], np.eye(2))
    assert len({element.tobytes() for element in found}) == 8
    products = {(a @ b + 0.0).tobytes() for a in found for b in found}
    assert products == {element.tobytes() for element in found}


def test_a_generator_gives_each_signal_its_new_value() -> None:
    element = group({"turn": TURN}, ["x", "y", "z"])[1]
    np.testing.assert_array_equal(element @ [1.0, 2.0, 3.0], [2.0, -1.0, 3.0])


def test_those_of_signals_keep_inputs_and_outputs_apart() -> None:
    odd = {"u": "-u", "y": "-y"}
    symmetry = {
        "odd": odd,
        "output": {"y": "-y"},
        "mixed": {"u": "y", "y": "u"},
        "inner": {"u": "-u", "force": "-force"},
        "nothing": {},
    }
    assert of_signals(symmetry, ["u"], ["y"]) == {"odd": odd, "output": {"y": "-y"}}


def test_a_generator_that_leads_to_a_signal_left_out_is_refused() -> None:
    with pytest.raises(UserError, match="'y'"):
        group({"turn": TURN}, ["x"])


@pytest.mark.parametrize(
    ("symmetry", "words"),
    [
        ({"odd": {"u": "-w"}}, "no signal 'w'"),
        ({"odd": {"u": "y"}}, "no permutation"),
        ({"odd": {"u": "y", "y": "y"}}, "no permutation"),
    ],
)
def test_an_invalid_symmetry_is_refused(symmetry: Symmetry, words: str) -> None:
    with pytest.raises(UserError, match=words):
        check_symmetry(symmetry, ["u"], ["y"], None)
    check_symmetry({"odd": {"u": "-u", "y": "-y"}}, ["u"], ["y"], None)


def test_a_large_group_is_refused() -> None:
    names = [f"s{i}" for i in range(8)]
    cycle = dict(zip(names, [*names[1:], names[0]], strict=True))
    swap = {"s0": "s1", "s1": "s0"}
    with pytest.raises(UserError, match="more than 64"):
        group({"cycle": cycle, "swap": swap}, names)
