"""Information in the literals of a source, and the source with its literals perturbed."""

import ast

import numpy as np
import pytest

from asia.candidate import executed_source
from asia.literals import (
    DIGIT,
    Literals,
    equations_as_code,
    literals,
    merged,
    number_bits,
    perturbed,
)


def of(source: str) -> Literals:
    text = executed_source(source + "\n\ndef fit(trajectories, context):\n    pass\n")
    return literals(text, ast.parse(text))


NONE = of("")


def bits(source: str, *known: Literals) -> float:
    return of(source).bits_beyond(NONE, *known)


@pytest.mark.parametrize(
    ("text", "digits", "more"),
    [
        ("7", 1, 0.0),
        ("1000", 1, 2.0),
        ("9.81", 3, 1.0),
        ("0.00981", 3, np.log2(3)),
        ("1.50", 3, 1.0),
        ("1e-3", 1, DIGIT * 2),
        ("1_234", 4, 0.0),
    ],
)
def test_a_number_has_the_bits_of_its_digits_and_its_size(text, digits, more):
    assert number_bits(text) == pytest.approx(digits * DIGIT + more)


def test_numbers_in_other_bases_have_the_bits_of_their_digits():
    assert number_bits("0xffff") == 16.0
    assert number_bits("0b1010") == 4.0


def test_comments_and_docstrings_hold_nothing():
    assert bits('"""3.14159 and more."""\n# 2.71828\nx = None') == bits("x = None")


@pytest.mark.parametrize(
    ("reader", "source"),
    [
        ("inspect", "import inspect\nx = 1.5"),
        ("getattr", "x = 1.5\nlonger_name = getattr(x, 'a' + 'b')"),
        ("__dict__", "x = getattr(fit, '__dict__')"),
        ("**kwargs", "def f(**given): return list(given)\nx = 1.5"),
        ("FileIO", "import io\nx = io.FileIO('/proc/self/mem')"),
        ("open", "with open('notes') as file:\n    x = 1.5"),
    ],
)
def test_a_reading_of_the_own_text_counts_all_of_it(reader, source):
    assert of(source).reader == reader
    assert bits(source) > bits("x = 1.5") + 100.0


def test_a_program_that_cannot_read_its_text_is_counted_by_its_literals():
    assert of("x = 1.5\nlonger_name = x").reader == ""


@pytest.mark.parametrize(
    "source",
    [
        "x = ({})".format(", ".join("ab"[i * i % 7 % 2] for i in range(64))),
        "x = a {}".format(" ".join("+-"[i * i % 7 % 2] + " b" for i in range(64))),
        "x = a {}".format(" ".join("<>"[i * i % 7 % 2] + " b" for i in range(64))),
        "x = {}a{}".format("".join("fg"[i * i % 7 % 2] + "(" for i in range(64)), ")" * 64),
        "\n".join(f"{'ab'[i * i % 7 % 2]}()" for i in range(64)),
        "x = {}a".format("".join("-~"[i * i % 7 % 2] for i in range(64))),
        "x = [{}]".format(", ".join(("True", "False")[i * i % 7 % 2] for i in range(64))),
    ],
)
def test_choices_in_a_row_hold_a_bit_each(source):
    assert 60.0 <= bits(source) <= 200.0


def test_a_short_row_of_names_holds_nothing():
    assert bits("x = (a, b, a, c)") == 0.0


def test_what_a_known_source_has_costs_nothing():
    source = "x = 9.81\nname = 'pump'\ny = [1, 2, 3, 4, 5, 6, 7, 8, 9]"
    assert bits(source) > 60.0
    assert bits(source, of(source)) == 0.0
    assert bits(source + "\nz = 2.5", of(source)) == pytest.approx(number_bits("2.5"))


def test_a_change_in_a_long_row_costs_its_own_bits():
    first = [k % 10 for k in range(100)]
    other = [*first[:50], 7, *first[51:]]
    known = of(f"x = {first}")
    assert bits(f"x = {other}", known) == pytest.approx(DIGIT)


def test_a_library_is_a_vocabulary_and_no_table():
    library = merged([of("a = 0.25\nb = 0.25"), of("c = 0.75")])
    assert bits("x = 0.25\ny = 0.75", library) == 0.0
    assert bits("x = 0.25\ny = 0.25", library) == pytest.approx(number_bits("0.25"))
    assert bits("x = [" + "0.25, 0.75, " * 20 + "]", library) > 200.0


def moved(source: str, known: Literals = NONE, **settings: bool) -> str:
    found = perturbed(ast.parse(source), known, 5, **settings)
    assert found is not None
    return found


def test_a_number_moves_by_one_in_its_last_digit():
    namespace: dict[str, float] = {}
    exec(moved("a = 9.81\nb = 1.5e-07\nc = 1234"), namespace)
    assert abs(namespace["a"] - 9.81) == pytest.approx(0.01)
    assert abs(namespace["b"] - 1.5e-7) == pytest.approx(1e-8)
    assert abs(namespace["c"] - 1234) == 1


def test_choices_of_one_digit_stay():
    for source in ("x = y ** 0.5", "x = y[2]", "order = 3", "limit = 1000", "ridge = 1e-3"):
        assert perturbed(ast.parse(source), NONE, 5) is None


def test_known_numbers_stay():
    assert perturbed(ast.parse("x = 9.81"), of("x = 9.81"), 5) is None
    assert "9.81" in moved("x = 9.81\ny = 2.5", of("x = 9.81"))


def test_a_table_moves_whatever_it_is_made_of():
    digits = [k * k % 9 + 1 for k in range(64)]
    found = ast.literal_eval(moved(f"{digits}"))
    apart = np.abs(np.subtract(found, digits))
    assert apart.min() >= 1
    text = "".join(chr(97 + k * k % 26) for k in range(64))
    assert moved(f"x = {text!r}") != f"x = {text!r}"
    names = "x = ({})".format(", ".join("ab"[k * k % 7 % 2] for k in range(64)))
    assert moved(names) != names
    assert perturbed(ast.parse(f"x = {text!r}"), NONE, 5, strings=False) is None


EQUATIONS = """
from dataclasses import replace

from asia.models import greybox
from asia.models.greybox import ParameterRange, Physics
from asia.models.methods import LevenbergMarquardt

PHYSICS = Physics(
    states=("position", "speed"),
    dynamics={"position": "speed", "speed": "g*angle - d*speed - 2.5*speed*abs(speed)"},
    parameters={"d": ParameterRange(0.01, 10.0), "g": ParameterRange(0.3, 30.0)},
)

def build_model(context):
    config = greybox.Config(friction=("speed",))
    return greybox.build(config, replace(context, physics=PHYSICS))

def train(model, trajectories, context):
    return greybox.train(model, trajectories, context, LevenbergMarquardt(iterations=60))

def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
"""


def test_declared_equations_count_as_the_code_that_they_are() -> None:
    found = equations_as_code(ast.parse(EQUATIONS))
    text = ast.unparse(found)
    data = literals(text, ast.parse(text))
    assert data.strings == frozenset()
    assert data.numbers["2.5"] == 1
    long = EQUATIONS.replace('"speed":', f'"speed": "{" + ".join("dgdgddggd")}", "x":')
    text = ast.unparse(equations_as_code(ast.parse(long)))
    assert len(literals(text, ast.parse(text)).runs) == 1


@pytest.mark.parametrize(
    ("part", "other"),
    [
        ("import ParameterRange, Physics", "import ParameterRange, Physics, np"),
        ("from asia.models import greybox", "from asia.models import greybox as g"),
        ("from asia.models import greybox", "import numpy"),
        ("from dataclasses import replace", "from dataclasses import asdict"),
        ("replace(context, physics=PHYSICS)", "replace(context, log=PHYSICS)"),
        ("replace(context, physics=PHYSICS)", "replace(context, physics=len)"),
        ("greybox.build(config,", "greybox.build(PHYSICS.states,"),
        ("iterations=60", "iterations=60 + 1"),
        ("    config =", "    greybox = PHYSICS\n    config ="),
        ("def fit(trajectories, context):", "def fit(trajectories, context, n=PHYSICS):"),
        ("def fit(", "def read(trajectories, context): return PHYSICS\n\ndef fit("),
        ("    return train(build", "    for name in PHYSICS.states: pass\n    return train(build"),
        ('("position", "speed")', '("position", f"speed")'),
        ("states=(", "**PHYSICS, states=("),
    ],
)
def test_a_source_that_computes_has_strings(part: str, other: str) -> None:
    assert part in EQUATIONS
    tree = ast.parse(EQUATIONS.replace(part, other))
    assert equations_as_code(tree) is tree
