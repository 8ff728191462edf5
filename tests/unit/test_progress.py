"""Progress lines of long commands."""

from __future__ import annotations

from threading import Event

import pytest

from asia import _progress
from asia._progress import progress_line, reported, tracked


def test_a_line_names_the_step_and_estimates_the_remaining_time() -> None:
    assert progress_line("linear", 7.2, ()) == "linear: 7 s"
    assert "first step" in progress_line("linear", 7.2, [("output", 0, 2, 7.0)])
    line = progress_line("validate", 12.0, [("check", 1, 4, 10.0), ("model", 1, 2, 3.0)])
    # 1.5 of 4 steps took 10 s.
    assert line == "validate: 12 s, check 2 of 4, model 2 of 2, about 17 s left"


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
    assert any(line.startswith("check: ") and "left" in line for line in lines)
