"""Results that fits share."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import asia.models
from asia.judge.sandbox.worker.wire import PROGRAM_KEY
from asia.models import _reuse


@dataclass(frozen=True)
class Given:
    values: np.ndarray
    name: str
    order: int | None = None


class Results(dict[str, bytes]):
    def put(self, key: str, value: bytes) -> None:
        self[key] = value


def computed(
    given: tuple[object, ...], what: str = "sum"
) -> tuple[bool, list[tuple[float, float]]]:
    """Whether it was computed, and what the log received."""
    calls, log = list[int](), list[tuple[float, float]]()

    def compute(inner: object) -> float:
        calls.append(1)
        inner(1.0, 0.5)  # pyright: ignore[reportCallIssue]
        return 3.0

    assert _reuse.reused(what, given, compute, lambda a, b: log.append((a, b))) == 3.0
    return bool(calls), log


def test_the_same_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    given = (Given(np.arange(3.0), "a"), [1, 2.0, None])
    assert computed(given)[0]
    assert computed(given)[0]  # outside a worker
    monkeypatch.setattr(_reuse, "store", Results())
    again = (Given(np.arange(3.0), "a"), [1, 2.0, None])
    assert computed(given) == (True, [(1.0, 0.5)])
    assert computed(again) == (False, [(1.0, 0.5)])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((np.arange(3.0),), (np.arange(3),)),
        ((np.zeros((2, 3)),), (np.zeros((3, 2)),)),
        ((Given(np.zeros(1), "a"),), (Given(np.zeros(1), "b"),)),
        ((Given(np.zeros(1), "a"),), (Given(np.zeros(1), "a", 0),)),
        (((1, 2), 3), ((1,), 2, 3)),
        (("ab", "c"), ("a", "bc")),
        ((1,), (1.0,)),
        ((0.0,), (-0.0,)),
        ((np.array([0.0]),), (np.array([-0.0]),)),
        ((True,), (1,)),
    ],
)
def test_nothing_else_reads_alike(
    one: tuple[object, ...], other: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_reuse, "store", Results())
    assert computed(one)[0]
    assert computed(other)[0]
    assert computed(one, "product")[0]


def test_what_has_no_content_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_reuse, "store", Results())
    with pytest.raises(TypeError, match="no hash"):
        computed((print,))


def test_the_store_of_a_search_takes_all_names() -> None:
    package = Path(asia.models.__file__).parent
    sources = "".join(file.read_text() for file in package.rglob("*.py"))
    names = re.findall(r"\breused\(\s*\"([^\"]+)\"", sources)
    assert len(names) == len(set(names)) == sources.count("reused(") - 1
    assert all(PROGRAM_KEY.fullmatch(name.encode()) for name in names)
