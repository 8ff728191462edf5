"""Agents against each other."""

from pathlib import Path

import pytest

from asia.assurance.bench.comparison import Arm, ComparisonPlan, PlannedRun, bench, paired_table
from asia.ledger.events import Event
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from tests.unit.search.toy import Scripted, arx, write_problem


class Quiet:
    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        pass

    def on_event(self, event: Event, view: SearchView) -> None:
        pass

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        pass


@pytest.mark.long
def test_agents_are_compared_pair_by_pair_and_no_test_is_declared(tmp_path: Path) -> None:
    good = Arm("good", "good", lambda: Scripted((arx(2),), "good"))
    bad = Arm("bad", "bad", lambda: Scripted((arx(3),), "bad"))
    plan = ComparisonPlan(
        problem=load_problem(write_problem(tmp_path / "toy")),
        arms=(good, bad),
        seeds=(0, 1),
        runs=tmp_path / "runs",
        settings=("inner",),
        experiments=2,
        word="compare",
    )
    result = bench(plan, Quiet())
    assert result.declared is None
    assert not (plan.directory / "bench.json").exists()
    paired = result.tables[-1]
    assert paired.title == "Paired by seed"
    (row,) = paired.rows
    assert row[0] == "good : bad"
    assert row[2] in ("0 of 2", "2 of 2")
    assert float(row[4]) == pytest.approx(0.5)
    (reached,) = result.comparisons[0].reached
    assert (reached.arm, reached.control) == ("good", "bad")
    assert any(p.suffix == ".png" for p in result.pictures)


def test_one_agent_alone_has_no_pair() -> None:
    assert paired_table([]) is None
