"""Limits on the data in a source, and the part of it that a worker reads."""

import base64
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import asia
from asia._source import source_facts
from asia.agents import Facts
from asia.agents.expert.agent import ExpertAgent
from asia.agents.library.family import under_protocol
from asia.agents.library.registry import all_families
from asia.agents.llm.prompt import EXAMPLE
from asia.agents.random import _drawn, paper_families
from asia.candidate import (
    MOST_ALIKE,
    MOST_CODE,
    MOST_LITERALS,
    MOST_NAMES,
    check_source,
    executed_source,
    source_digest,
)
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.references import LINEAR
from tests.unit.agents.searches import body, search, simulation, windows

FIT = "def fit(trajectories, context):\n    return TABLE\n"
RNG = np.random.default_rng(0)
RECORD = np.round(RNG.normal(size=1000).cumsum(), 3).tolist()
PAYLOAD = base64.b85encode(RNG.bytes(1500)).decode()
MARGIN = 5
MOST = np.array([MOST_LITERALS, MOST_NAMES, MOST_ALIKE, MOST_CODE])


def figures(source: str) -> np.ndarray:
    return np.array(source_facts(source).content)


def library_sources() -> list[str]:
    """Sources that the built-in agents may write, and those that come with the problems."""
    root = Path(asia.__file__).parent
    files = [*root.glob("problems/*/baseline.py"), *root.glob("bench/candidates/*.py")]
    sources = [LINEAR, EXAMPLE, *(path.read_text() for path in files)]
    rng = np.random.default_rng(1)
    for facts in (simulation(physics=True), windows(), body()):
        sources += [t.source for t in search(ExpertAgent, facts, 30)]
        sources += drawn(rng, facts)
    return sources


def drawn(rng: np.random.Generator, facts: Facts) -> list[str]:
    rows = [row for row in (*all_families(), *paper_families(facts)) if row.suits(facts)]
    return [
        under_protocol(_drawn(rng, row, facts), row, facts).source(row.label)
        for row in rows
        for _ in range(10)
    ]


TABLES = {
    "numbers": repr(RECORD),
    "string": repr(PAYLOAD),
    "bytes": repr(base64.b85decode(PAYLOAD)),
    "f-string": "f'{0}" + PAYLOAD.replace("{", "").replace("}", "") + "'",
    "names": "dict(" + ", ".join(f"_{w}=0" for w in RNG.bytes(4000).hex(" ", 8).split()) + ")",
    "letters": f"lambda: [{','.join(RNG.choice(list('abcdefghijklmnopqrstuvwxyz'), 30_000))}]",
}


SIGNS = ("+", "-", "*", "/")


def rows(words: list[str], count: int = 32) -> list[list[str]]:
    return [words[i : i + count] for i in range(0, len(words), count)]


def names(data: bytes) -> list[str]:
    """One of 256 for each byte."""
    return [chr(97 + b // 16) + chr(65 + b % 16) for b in data]


def calls(data: bytes) -> list[str]:
    """One of 16 for each half byte."""
    return [f"{chr(97 + v)}(" for b in data for v in (b // 16, b % 16)]


def bits(data: bytes) -> list[int]:
    return np.unpackbits(np.frombuffer(data, np.uint8)).tolist()


def sums(data: bytes) -> list[str]:
    """One of four operators for two bits."""
    return [f"{SIGNS[b // s % 4]}x" for b in data for s in (64, 16, 4, 1)]


def keywords(row: list[str]) -> str:
    return ", ".join(f"{key}={word}" for key, word in zip("abcdefgh", row, strict=False))


DISGUISES: dict[str, Callable[[bytes], list[str]]] = {
    "names in a tuple": lambda d: [f"x = {', '.join(names(d))}"],
    "names in many tuples": lambda d: [f"x = {', '.join(r)}" for r in rows(names(d), 8)],
    "operators": lambda d: [f"x = x{''.join(sums(d))}"],
    "operators in many sums": lambda d: [f"x = x{''.join(r)}" for r in rows(sums(d))],
    "sums of many lengths": lambda d: [
        f"x = x{''.join(r[i % 9 :])}" for i, r in enumerate(rows(sums(d), 40))
    ],
    "nested calls": lambda d: [f"{''.join(r)}x{')' * len(r)}" for r in rows(calls(d))],
    "keyword arguments": lambda d: [f"x({keywords(r)})" for r in rows(names(d), 8)],
    "a statement a bit": lambda d: ["ab"[b] for b in bits(d)],
    "a call a bit": lambda d: [f"{'ab'[b]}()" for b in bits(d)],
    "attribute chains": lambda d: [f"x.{'.'.join(r)}" for r in rows(names(d))],
    "assignments": lambda d: [f"{a} = {b}" for a, b in rows(names(d), 2)],
    "conditions": lambda d: [f"if {a} < {b}: x()" for a, b in rows(names(d), 2)],
    "functions": lambda d: [f"def {a}(): {b}" for a, b in rows(names(d), 2)],
}


@pytest.mark.slow
@pytest.mark.parametrize("disguise", DISGUISES.values(), ids=DISGUISES)
def test_a_kilobyte_in_statements_alike_is_refused(disguise: Callable[[bytes], list[str]]):
    def table(size: int) -> str:
        return "\n".join((*disguise(np.random.default_rng(2).bytes(size)), "TABLE = x", FIT))

    check_source(table(64))
    with pytest.raises(CandidateError, match=r"statements of one kind|nested too deeply"):
        check_source(table(1024))


@pytest.mark.slow
@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_a_source_that_brings_a_record_along_is_refused(table: str):
    with pytest.raises(CandidateError) as caught:
        check_source(f"TABLE = {table}\n{FIT}")
    assert caught.value.reason is Reason.LITERAL_DATA
    assert "compressed" in caught.value.detail
    assert "training records" in caught.value.reason.advice


@pytest.mark.slow
def test_what_the_library_writes_stays_far_below_the_bounds():
    sources = library_sources()
    assert len(sources) > 500
    assert (np.max([figures(source) for source in sources], axis=0) * MARGIN < MOST).all()


@pytest.mark.slow
def test_a_family_written_out_by_hand_passes():
    """The longest candidate of the recorded searches of agents has 370 lines."""
    for path in (Path(asia.__file__).parent / "models").rglob("*.py"):
        source = path.read_text()
        if len(source.splitlines()) > 400:
            continue
        found = figures(source)
        assert found[0] < MOST_LITERALS, path.name
        assert (found[1:] < MOST[1:]).all(), path.name


DRESSED = '''"""A table: 1 2 3
4 5 6"""
# 7 8 9
import numpy as np  # 10


class Model:
    """11"""

    words = "# not a comment"

    def simulate(self, past_u, past_y, u):
        """12

        13"""; return u  # 14


def fit(trajectories, context):
    ("15")
    text = f"#{1}" """#
    two"""
    raise ValueError(text)  # 16
'''


def test_a_worker_gets_neither_comments_nor_docstrings():
    bare = executed_source(DRESSED)
    for number in range(7, 17):
        assert str(number) not in bare.replace("# not", "")
    assert "4 5 6" not in bare
    assert '"# not a comment"' in bare
    assert source_digest(bare) == source_digest(DRESSED)
    assert len(bare.splitlines()) == len(DRESSED.splitlines())
    raises = [line.startswith("    raise") for line in bare.splitlines()]
    assert raises == [line.startswith("    raise") for line in DRESSED.splitlines()]


@pytest.mark.parametrize("end", ["\r\n", "\r", "\x0c\n"])
def test_other_line_ends_change_nothing(end: str):
    dressed = DRESSED.replace("\n", end)
    assert source_digest(executed_source(dressed)) == source_digest(dressed)
    assert " 16" not in executed_source(dressed)


def test_words_count_as_nothing():
    words = "".join(f"# {line}\n" for line in PAYLOAD.split("a"))
    assert (figures(f'"""{PAYLOAD}"""\n{FIT}{words}') <= (2, 32, 64, 64)).all()
