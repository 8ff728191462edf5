"""Progress lines of long commands."""

from __future__ import annotations

from threading import Event

import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia import _progress
from asia._progress import now_doing, progress_line, reported, tracked


def test_a_line_names_the_step_and_estimates_the_remaining_time() -> None:
    assert progress_line("linear", 7.2, ()) == "linear: 7 s"
    first = progress_line("linear", 7.2, [("output", 0, 2, 0.0, 7.0)])
    assert first == "linear: 7 s, output 1 of 2"
    loops = [("check", 1, 4, 10.0, 2.0), ("model", 1, 2, 3.0, 2.0)]
    # 1.5 of 4 steps took 10 s, and 2 s of the rest are over.
    line = progress_line("validate", 12.0, loops)
    assert line == "validate: 12 s, check 2 of 4, model 2 of 2, about 15 s left"


@given(
    done=st.integers(1, 5),
    worked=st.floats(0.0, 1e3),
    waits=st.lists(st.floats(0.0, 1e4), min_size=2, max_size=2).map(sorted),
)
def test_the_remaining_time_never_grows_within_a_step(
    done: int, worked: float, waits: list[float]
) -> None:
    left: list[float] = []
    for wait in waits:
        line = progress_line("check", worked + wait, [("output", done, 6, worked, wait)])
        left.append(float(line.split("about ")[1].split()[0]) if "about" in line else 0.0)
    assert left[1] <= left[0]


def test_items_are_counted_where_a_command_runs_and_pass_unchanged_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_progress, "SILENCE", 0.01)
    assert list(tracked([1, 2], "item")) == [1, 2]
    lines, printed = list[str](), Event()

    def say(line: str) -> None:
        lines.append(line)
        if "item 2 of 2" in line:
            printed.set()

    with reported("check", say):
        for item in tracked([1, 2], "item"):
            if item == 2:
                assert printed.wait(30)
    assert all(line.startswith("check: ") for line in lines)


def test_a_step_that_counts_nothing_is_named_until_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert progress_line("run", 9.0, [("refit", 0, 0, 0.0, 5.0)]) == "run: 9 s, refit"
    monkeypatch.setattr(_progress, "SILENCE", 0.01)
    now_doing("nobody listens")
    lines, printed = list[str](), Event()

    def say(line: str) -> None:
        lines.append(line.partition(", ")[2])
        if lines[-1] == "second":
            printed.set()

    with reported("run", say):
        now_doing("first")
        now_doing("second")
        assert printed.wait(30)
        for _ in tracked([1], "item"):
            now_doing("third")
            assert progress_line("run", 1.0, []) == "run: 1 s"
    assert set(lines) <= {"", "first", "second", "item 1 of 1", "item 1 of 1, third", "third"}
