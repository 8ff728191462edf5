"""A relay with a program as its last agent, evaluated as any search is: in its jail, killed at the
hand-over, and in `asia bench agents`."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from asia.ledger.events import HandedOver
from asia.ledger.run import open_run
from asia.search.replay import replay_run
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import write_problem

PROGRAM = """
import pathlib, re, subprocess
source = pathlib.Path("candidate.py")
for order in (2, 3):
    source.write_text(re.sub(r"n = \\d+", f"n = {order}", source.read_text()))
    tried = subprocess.run(["asia", "try", "-m", f"order {order}"], capture_output=True, text=True)
    print(tried.stdout, tried.stderr)
    if tried.returncode:
        break
"""


def outcomes(directory: Path) -> list[tuple[int, str, str, float | None]]:
    return [
        (e.proposed.leg, e.proposed.agent, e.proposed.digest,
         None if e.score is None else e.score.value)
        for e in open_run(directory).view.experiments
    ]  # fmt: skip


@pytest.mark.long
def test_a_program_goes_on_where_the_expert_ends(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=4)
    tool = tmp_path / "tool"
    tool.mkdir()
    (tool / "mine.py").write_text(PROGRAM)
    command = f"{sys.executable} {tool / 'mine.py'} {{prompt_file}}"
    words = ("run", problem, "--agent", "expert*2,command:mine", "--command", command,
             "--agent-mount", tool)  # fmt: skip
    done = command_line(*words, "--runs", tmp_path / "runs")
    assert done.code == 0, done.err
    assert "mine takes over after #02" in done.out
    run = tmp_path / "runs" / "toy-expert2+mine-s0"
    first = outcomes(run)
    assert [(leg, agent) for leg, agent, *_ in first] == [
        (1, ""), (1, "expert"), (2, "mine"), (2, "mine"),
    ]  # fmt: skip
    assert all(value is not None for *_, value in first)

    lines = (run / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    events = [line.event for line in open_run(run).lines]
    place = next(i for i, event in enumerate(events) if isinstance(event, HandedOver))
    shutil.copytree(run, tmp_path / "killed" / run.name)
    (tmp_path / "killed" / run.name / "ledger.jsonl").write_bytes(b"".join(lines[: place + 1]))
    again = command_line(*words, "--runs", tmp_path / "killed")
    assert again.code == 0, again.err
    assert outcomes(tmp_path / "killed" / run.name) == first

    report = replay_run(run, lambda item: None)
    assert report.agrees, [item for item in report.items if not item.agrees]


@pytest.mark.long
def test_a_relay_is_compared_like_any_agent(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy")
    done = command_line("bench", "agents", problem, "--agents", "random,expert*2+random",
                        "--seeds", 1, "--experiments", 3, "--runs", tmp_path / "runs")  # fmt: skip
    assert done.code == 0, done.err
    assert "| expert*2+random, best of 3 |" in done.out
    pair = next(line for line in done.out.splitlines() if "random : expert2+random" in line)
    assert "0 of 1" in pair
    relay = outcomes(tmp_path / "runs" / "compare-toy-expert2+random-inner-s0")
    assert [leg for leg, *_ in relay] == [1, 1, 2]
