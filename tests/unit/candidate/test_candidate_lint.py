"""How much data a source may carry, and what of it a worker gets to read."""

import ast
import base64
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.agents import ExpertAgent, Facts
from asia.agents._library import FAMILIES
from asia.agents._llm_problem import EXAMPLE
from asia.agents._paper import paper_families
from asia.agents._random import _drawn
from asia.agents._training import under_protocol
from asia.candidate import check_source, executed_source, source_digest
from asia.candidate._lint import MOST_CODE, MOST_LITERALS, MOST_NAMES, content
from asia.errors import CandidateError, Reason
from asia.evaluation import LINEAR
from tests.unit.agents.searches import body, search, simulation, windows

FIT = "def fit(trajectories, context):\n    return TABLE\n"
RNG = np.random.default_rng(0)
RECORD = np.round(RNG.normal(size=1000).cumsum(), 3).tolist()
PAYLOAD = base64.b85encode(RNG.bytes(1500)).decode()
MARGIN = 8


def figures(source: str) -> tuple[int, int, int]:
    found = content(source, ast.parse(source))
    return found.literals, found.names, found.code


def library_sources() -> list[str]:
    """What the built-in agents may write, and what comes with the problems."""
    root = Path(asia.__file__).parent
    files = [*root.glob("problems/*/baseline.py"), *root.glob("bench/candidates/*.py")]
    sources = [LINEAR, EXAMPLE, *(path.read_text() for path in files)]
    rng = np.random.default_rng(1)
    for facts in (simulation(physics=True), windows(), body()):
        sources += [t.source for t in search(ExpertAgent, facts, 30)]
        sources += drawn(rng, facts)
    return sources


def drawn(rng: np.random.Generator, facts: Facts) -> list[str]:
    rows = [row for row in (*FAMILIES, *paper_families(facts)) if row.suits(facts)]
    return [
        under_protocol(_drawn(rng, row, facts), facts).source(row.label)
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


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_a_source_that_brings_a_record_along_is_refused(table: str):
    with pytest.raises(CandidateError) as caught:
        check_source(f"TABLE = {table}\n{FIT}")
    assert caught.value.reason is Reason.LITERAL_DATA
    assert "compressed" in caught.value.detail
    assert "training records" in caught.value.reason.advice


def test_what_the_library_writes_stays_far_below_the_bounds():
    sources = library_sources()
    assert len(sources) > 500
    literals, names, code = np.max([figures(source) for source in sources], axis=0)
    assert literals * MARGIN < MOST_LITERALS
    assert names * MARGIN < MOST_NAMES
    assert code * MARGIN < MOST_CODE


def test_a_family_written_out_by_hand_passes():
    for path in (Path(asia.__file__).parent / "models").glob("*.py"):
        found = figures(path.read_text())
        assert found < (MOST_LITERALS, MOST_NAMES, MOST_CODE), path.name
        assert found[1] < MOST_NAMES / 2


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
    assert figures(f'"""{PAYLOAD}"""\n{FIT}{words}') <= (2, 32, 64)
