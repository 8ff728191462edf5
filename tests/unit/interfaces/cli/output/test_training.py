"""Words of a try that need no key."""

from types import SimpleNamespace
from typing import Any

import pytest

from asia.interfaces.cli.agent import submission_line, training_lines
from asia.interfaces.cli.status import state_words
from asia.interfaces.workspace.server import Submission
from asia.judge.scoring.residuals import Diagnostics


def test_every_figure_of_the_training_side_is_named_in_words() -> None:
    said = " ".join(training_lines(Diagnostics(0.11, 0.12, 0.13, 0.14, 1.5, 1.6, 1.7, 0.18)))
    for words in (
        "error 0.11 as in V", "mean residual 0.12 s.d.", "its own past 0.13",
        "past inputs 0.14", "squared output 0.18", "top tenth 1.50", "bottom tenth 1.60",
        "first 5 % of a record 1.70",
    ):  # fmt: skip
        assert words in said, words


def test_the_search_is_not_said_to_begin_with_references_that_were_said_already() -> None:
    now: Any = SimpleNamespace(running=None, experiments=0)
    said = submission_line(Submission("t", "queued"), now)
    assert said == "the search evaluates the reference models, then the baseline"
    now.experiments = 1
    assert submission_line(Submission("t", "queued"), now) == "queued, it is next"


@pytest.mark.parametrize(
    ("agent", "pending", "said"),
    [
        ("workspace", None, "waiting for a candidate"),
        ("workspace", "one", "running"),
        ("expert", None, "running"),
    ],
)
def test_an_idle_workspace_is_not_called_running(agent: str, pending: Any, said: str) -> None:
    view = SimpleNamespace(
        started=SimpleNamespace(agent=agent), experiments=("one",), pending=pending, budget=5
    )
    found: Any = SimpleNamespace(view=view, state="running", finished=1)
    assert state_words(found) == said
