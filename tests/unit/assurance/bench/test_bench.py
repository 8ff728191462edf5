"""Comparisons on a toy problem, with scripted agents."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from asia.assurance.bench.comparison import (
    QUICK_EXPERIMENTS,
    Arm,
    BenchResult,
    ComparisonPlan,
    FixedAgent,
    Paper,
    PaperTest,
    PaperV,
    PlannedRun,
    bench,
    make_arms,
    paper,
    reference_agent,
    result_object,
    select_arms,
)
from asia.candidate import check_source
from asia.errors import UserError
from asia.ledger.events import Event
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem

PAPER = Paper(
    experiments=3,
    references=("rnn4",),
    values=(
        PaperV("RNN-4", 0.681, "rnn4"),
        PaperV("never rebuilt", 0.43),
        PaperV("agentic search", 0.25, "expert"),
    ),
    test=(PaperTest("paper's ensemble", 0.298),),
    protocol="How the paper measured.",
)
EXPERT = Arm("expert", "expert", lambda: Scripted((arx(2),), "expert"))
RANDOM = Arm("random", "random", lambda: Scripted((CRASH, arx(3)), "random"))
REFERENCES = Arm("references", "references", lambda: FixedAgent((("RNN-4", arx(2)),)), 1)


@dataclass
class Log:
    """Report of a comparison."""

    runs: list[str] = field(default_factory=list[str])
    events: int = 0

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        self.runs.append(f"{number}/{total} {run.name}")

    def on_event(self, event: Event, view: SearchView) -> None:
        self.events += 1

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        pass


@dataclass(frozen=True)
class Compared:
    plan: ComparisonPlan
    log: Log
    result: BenchResult


def make_plan(problem: Problem, runs: Path, **changes: object) -> ComparisonPlan:
    plan = ComparisonPlan(
        problem, (EXPERT, RANDOM, REFERENCES), (0,), runs, experiments=3, paper=PAPER
    )
    return replace(plan, **changes)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module", autouse=True)
def _without_jax() -> Iterator[None]:
    """The linear reference by the toy's own least squares: a compilation in every run would be most
    of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
        yield


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return load_problem(write_problem(tmp_path_factory.mktemp("bench") / "toy"))


@pytest.fixture(scope="module")
def compared(toy: Problem, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    plan, log = make_plan(toy, tmp_path_factory.mktemp("runs")), Log()
    return Compared(plan, log, bench(plan, log))


@pytest.mark.long
def test_every_search_is_a_run_of_its_own(compared: Compared) -> None:
    names = [line.split()[1] for line in compared.log.runs]
    assert names == [
        "bench-toy-expert-inner-s0",
        "bench-toy-random-inner-s0",
        "bench-toy-expert-validation-s0",
        "bench-toy-random-validation-s0",
        "bench-toy-references-validation-s0",
    ]
    for name in names:
        run = open_run(compared.plan.runs / name)
        assert run.state == "finished"
        assert run.view.started.early_stopping == name.split("-")[-2]


@pytest.mark.slow
def test_the_two_settings_share_no_table(compared: Compared) -> None:
    inner, validation, test = compared.result.tables
    assert "inner" in inner.title
    assert "V paper" not in inner.header
    assert not any("0.681" in cell or "0.25" in cell for row in inner.rows for cell in row)
    assert any("Not comparable" in note and "RNN-4 0.681" in note for note in inner.notes)
    assert "not leak-free" in validation.title
    assert validation.header[-1] == "V paper"
    papers = {row[0]: row[-1] for row in validation.rows}
    assert papers["RNN-4, rebuilt"] == "0.6810"
    assert papers["expert, best of 2"] == "0.2500"
    assert papers["paper only: never rebuilt"] == "0.4300"
    assert papers["random, best of 3"] == "-"
    assert not any("Not comparable" in note for note in validation.notes)
    assert any("that of run bench-toy-expert-inner-s0, once" in note for note in test.notes)
    assert dict(test.rows) == {"ours": "sealed", "paper's ensemble": "0.2980"}
    document = compared.result.document.read_text()
    assert all(table.markdown() in document for table in compared.result.tables)


@pytest.mark.slow
def test_rows_hold_the_ledgers_figures(compared: Compared) -> None:
    rows = {row.key: row for row in compared.result.comparisons[0].rows}
    assert set(rows) == {
        "training mean", "last output held", "linear model", "baseline", "random", "expert",
    }  # fmt: skip
    view = open_run(compared.plan.runs / "bench-toy-expert-inner-s0").view
    assert view.best is not None
    assert view.best.score is not None
    assert rows["expert"].values == (view.best.score.value,)
    assert rows["expert"].median == view.best.score.value < (rows["baseline"].median or 0)
    (reached,) = compared.result.comparisons[0].reached
    assert (reached.control, reached.seeds) == ("random", (0,))


@pytest.mark.slow
def test_json_keys(compared: Compared) -> None:
    answer = json.loads(json.dumps(result_object(compared.result), allow_nan=False))
    assert set(answer) == {"comparisons", "declared", "test", "document", "pictures"}
    assert [c["early_stopping"] for c in answer["comparisons"]] == ["inner", "validation"]
    for comparison in answer["comparisons"]:
        assert set(comparison) == {"early_stopping", "rows", "reached"}
        for row in comparison["rows"]:
            assert set(row) == {"key", "model", "V", "values", "runs", "paper", "scores_seen"}
        for reached in comparison["reached"]:
            assert set(reached) == {"control", "seeds", "experiments"}
    assert all(row["paper"] is None for row in answer["comparisons"][0]["rows"])
    assert answer["test"] is None
    assert answer["declared"] == "bench-toy-expert-inner-s0"


@pytest.mark.slow
def test_pictures(compared: Compared) -> None:
    pngs = {p.name for p in compared.result.pictures if p.suffix == ".png"}
    assert pngs == {
        "progress-inner.png", "progress-validation.png", "arms-inner.png", "arms-validation.png",
    }  # fmt: skip
    assert all(p.parent == compared.plan.directory for p in compared.result.pictures)


@pytest.mark.slow
def test_the_same_call_again_repeats_nothing(compared: Compared) -> None:
    before = {p: p.read_bytes() for p in compared.plan.runs.glob("*/ledger.jsonl")}
    log = Log()
    again = bench(compared.plan, log)
    assert log.events == 0
    assert again.comparisons == compared.result.comparisons
    assert {p: p.read_bytes() for p in compared.plan.runs.glob("*/ledger.jsonl")} == before


@dataclass
class Killed(Log):
    """Stops the comparison after so many events."""

    left: int = 7

    def on_event(self, event: Event, view: SearchView) -> None:
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt


@pytest.mark.long
def test_a_killed_comparison_goes_on(compared: Compared, toy: Problem, tmp_path: Path) -> None:
    plan = make_plan(toy, tmp_path, settings=("inner",), arms=(EXPERT,))
    with pytest.raises(KeyboardInterrupt):
        bench(plan, Killed())
    ledger = tmp_path / "bench-toy-expert-inner-s0" / "ledger.jsonl"
    there = ledger.read_bytes()
    result = bench(plan, Log())
    assert ledger.read_bytes().startswith(there)
    mine = {r.key: r.values for r in result.comparisons[0].rows}
    full = {r.key: r.values for r in compared.result.comparisons[0].rows}
    assert mine == {key: values for key, values in full.items() if key != "random"}


@pytest.mark.slow
def test_only_the_declared_run_is_unsealed(compared: Compared) -> None:
    declared = compared.plan.directory / "bench.json"
    assert json.loads(declared.read_text()) == {
        "problem": "toy",
        "declared": "bench-toy-expert-inner-s0",
    }
    sealed = [open_run(p.parent).view for p in compared.plan.runs.glob("*/ledger.jsonl")]
    assert not any(view.unsealing for view in sealed)
    result = bench(compared.plan, Log(), open_test=True)
    opened = {
        p.parent.name
        for p in compared.plan.runs.glob("*/ledger.jsonl")
        if open_run(p.parent).view.unsealing
    }
    assert opened == {"bench-toy-expert-inner-s0"}
    assert result.test is not None
    assert result.test.run == "bench-toy-expert-inner-s0"
    table = result.tables[-1]
    assert table.rows[0][0] == "ours, ensemble of the fold models"
    answer = result_object(result)["test"]
    assert set(answer) == {"run", "experiment", "ensemble", "refit"}
    assert table.rows[0][1] == f"{answer['ensemble']['rmse']:.4f}"
    later = replace(compared.plan, seeds=(0,), settings=("inner",), arms=(EXPERT,))
    assert bench(later, Log()).test is not None


def test_a_run_that_was_not_declared_is_never_unsealed(toy: Problem, tmp_path: Path) -> None:
    plan = make_plan(toy, tmp_path, settings=("inner",), arms=(RANDOM,))
    with pytest.raises(UserError, match="no run was declared before its search"):
        bench(plan, Log(), open_test=True)
    expert = replace(plan, arms=(EXPERT,))
    (tmp_path / "bench-toy-expert-inner-s0").mkdir()
    (tmp_path / "bench-toy-expert-inner-s0" / "ledger.jsonl").write_text("begun\n")
    with pytest.raises(UserError, match="no run was declared before its search"):
        bench(expert, Log(), open_test=True)
    with pytest.raises(UserError, match="--unseal with --quick"):
        bench(replace(expert, quick=True), Log(), open_test=True)
    assert len(list(tmp_path.glob("*/ledger.jsonl"))) == 1


def test_a_declaration_stands(toy: Problem, tmp_path: Path) -> None:
    first = make_plan(toy, tmp_path, seeds=(1,))
    first.directory.mkdir()
    (first.directory / "bench.json").write_text(
        '{"problem": "toy", "declared": "bench-toy-expert-inner-s0"}'
    )
    with pytest.raises(UserError, match="'bench-toy-expert-inner-s0' was declared"):
        bench(first, Log(), open_test=True)
    (first.directory / "bench.json").write_text('{"problem": "other", "declared": "x"}')
    with pytest.raises(UserError, match="does not declare a run of problem 'toy'"):
        bench(first, Log())


def test_the_plan(toy: Problem, tmp_path: Path) -> None:
    plan = make_plan(toy, tmp_path, seeds=(4, 2), experiments=None)
    assert plan.budget == PAPER.experiments
    assert [s.name for s in plan.searches][:3] == [
        "bench-toy-expert-inner-s4", "bench-toy-random-inner-s4", "bench-toy-expert-inner-s2",
    ]  # fmt: skip
    assert plan.candidate_for_test == "bench-toy-expert-inner-s4"
    only = replace(plan, settings=("validation",))
    assert only.candidate_for_test == "bench-toy-expert-validation-s4"
    assert replace(plan, arms=(RANDOM,)).candidate_for_test is None
    rules = {s.setting: s.problem.protocol for s in plan.searches}
    assert rules["inner"] == toy.protocol
    assert rules["validation"] == replace(toy.protocol, early_stopping="validation")
    budgets = {s.arm.name: s.problem.budget for s in plan.searches}
    assert budgets["references"].experiments == 2
    assert budgets["references"].fit_seconds >= 900
    quick = replace(plan, quick=True)
    assert quick.directory == tmp_path / "bench-toy-quick"
    assert quick.budget == QUICK_EXPERIMENTS
    assert {s.problem.budget.fit_seconds for s in quick.searches if not s.arm.fixed} == {20.0}
    assert replace(plan, paper=None).budget == toy.budget.experiments


@pytest.mark.parametrize(
    "changes", [{"seeds": (0, 0)}, {"seeds": ()}, {"arms": (EXPERT, EXPERT)}, {"settings": ()}]
)
def test_a_plan_names_everything_once(
    toy: Problem, tmp_path: Path, changes: dict[str, object]
) -> None:
    with pytest.raises(UserError, match="a comparison needs every"):
        make_plan(toy, tmp_path, **changes)


def test_arms_by_name() -> None:
    known = make_arms(paper("cascaded_tanks"))
    assert [a.name for a in known] == ["expert", "random", "random-paper", "references"]
    assert [a.make().name for a in known] == ["expert", "random", "random-paper", "references"]
    assert [a.name for a in make_arms(None)] == ["expert", "random", "random-paper"]
    assert select_arms(known, None) == known
    assert [a.name for a in select_arms(known, ["random", "expert"])] == ["random", "expert"]
    with pytest.raises(UserError, match="no arm 'llm'; there is: expert"):
        select_arms(known, ["llm"])


@pytest.mark.parametrize("problem", ["cascaded_tanks", "nanodrone"])
def test_the_papers_configurations_are_candidates(problem: str) -> None:
    figures = paper(problem)
    assert figures is not None
    agent = reference_agent(figures.references)
    assert len(agent.candidates) == len(figures.references)
    for _, source in agent.candidates:
        check_source(source)
        assert 'stop="validation"' in source
    assert {v.row for v in figures.values if v.row} <= {
        *figures.references,
        "baseline",
        "expert",
        "random-paper",
    }


def test_the_papers_figures() -> None:
    tanks, drone = paper("cascaded_tanks"), paper("nanodrone")
    assert tanks is not None
    assert drone is not None
    assert [v.value for v in tanks.values] == [0.681, 0.430, 0.250, 0.250]
    assert [v.value for v in drone.values] == [0.707, 0.31, 0.286]
    best = {g.group: (g.h10, g.h50, g.total) for g in drone.mee[-1].groups}
    assert best == {
        "p": (0.013, 0.096, 2.1),
        "v": (0.077, 0.342, 8.4),
        "R": (0.027, 0.149, 3.9),
        "omega": (0.314, 0.450, 19.6),
    }
    assert paper("two_tanks_sim") is None
