"""Every parser on inputs that no one meant it to have: those that fuzz/run.py found, nasty
ones, and Hypothesis' changes of good ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz.targets import NAMES, Place, Target, make_targets
from hypothesis import given, settings
from hypothesis import strategies as st

PLACE = Place()
TARGETS = make_targets(PLACE)
FOUND = sorted((Path(__file__).parents[3] / "fuzz" / "found").glob("*-*"))
NASTY = {
    "nothing": b"",
    "nul": b"\0",
    "half a character": b"\xc3",
    "half a surrogate pair": rb'{"source": "\ud800", "hypothesis": "\udc00", "op": "job"}',
    "deep lists": b"[" * 5000,
    "deep lists in TOML": b"a = " + b"[" * 5000,
    "deep tables in TOML": b"a." * 2000 + b"b = 1",
    "deep objects": b'{"a":' * 5000,
    "deep object in an object": b'{"usage": ' * 3000 + b"1" + b"}" * 3000,
    "long number": b"9" * 5000,
    "long number in TOML": b"sampling_time = " + b"9" * 5000,
    "number of an object": b'{"seed": ' + b"9" * 5000 + b"}",
    "huge exponent": b'{"total_cost_usd": 1e999, "type": "result"}',
    "not a number": b'{"total_cost_usd": NaN, "type": "result", "event": "steered", "text": NaN}',
    "list for an object": b"[1, 2]",
    "null": b"null",
    "deep expression": b"(" * 3000,
    "long expression": b"-" * 3999 + b"x",
    "tower": b"2**2**2**2**9**9",
    "number of CSV": b"u,y\n1e999,2\n",
    "quotes": b'"u","y\n"1,2\n',
    "carriage returns": b"u,y\r1,2\r\r\n3,4",
    "long line": b"u,y\n" + b"1," * 20000,
    "long cell": b"u,y\n" + b"1" * 200_000 + b",2\n",
    "UTF-16": "u,y\n1,2".encode("utf-16"),
    "odd UTF-16": "u,y\n1,2".encode("utf-16") + b"0",
    "date in TOML": b"sampling_time = 2020-01-01T00:00:00",
    "not a number in TOML": b"sampling_time = nan\n[budget]\nhours = -inf",
    "fences": b"\0```python\n" * 500,
    "thoughts": b"\0" + b"<think>" * 3000,
}


def run(target: Target, data: bytes) -> None:
    """Raises what the parser does not promise, and nothing else."""
    target(data)


def test_targets_are_all_named() -> None:
    assert tuple(TARGETS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_seeds_are_understood(name: str) -> None:
    """So that a fuzzer starts inside the parser: the first one at least raises nothing at all, but
    for those whose good end is an error."""
    if name == "lock":
        pytest.skip("its digests would have to fit")
    TARGETS[name].parse(TARGETS[name].seeds[0])
    for seed in TARGETS[name].seeds:
        run(TARGETS[name], seed)


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_what_was_found(path: Path) -> None:
    run(TARGETS[path.name.partition("-")[0]], path.read_bytes())


@pytest.mark.parametrize("name", NAMES)
def test_nasty_inputs(name: str) -> None:
    for data in NASTY.values():
        run(TARGETS[name], data)


@st.composite
def changed(draw: st.DrawFn, seeds: tuple[bytes, ...]) -> bytes:
    """A seed with some of it cut, doubled, or replaced."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, len(data)))
        last = draw(st.integers(first, min(len(data), first + 40)))
        middle = draw(
            st.one_of(
                st.just(b""),
                st.just(data[first:last] * 2),
                st.binary(max_size=8),
                st.sampled_from(
                    (b"[", b"{", b'"', b"\n", b"\0", b"\xff", b"-1", b"1e999", b"null")
                ),
            )
        )
        data = data[:first] + middle + data[last:]
    return data


@pytest.mark.parametrize("name", NAMES)
def test_changed_inputs(name: str) -> None:
    target = TARGETS[name]

    @settings(max_examples=60, deadline=None, database=None)
    @given(changed(target.seeds))
    def check(data: bytes) -> None:
        run(target, data)

    check()
