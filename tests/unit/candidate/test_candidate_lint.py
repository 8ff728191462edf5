"""The part of a source that a worker reads."""

import pytest

from asia.candidate import executed_source, source_digest

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
