"""Comparisons of agents and of the paper: plan, runs, declared test, tables, pictures."""

from __future__ import annotations

import itertools
import json
import statistics
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import TypeAdapter
from scipy.stats import wilcoxon

from asia._files import PACKAGE
from asia._text import printable_line
from asia.agents.registry import make_agent
from asia.agents.view import Agent, AgentView, Proposal
from asia.errors import UserError
from asia.judge.evaluation.references import LINEAR_REFERENCE
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.chain import write_whole
from asia.ledger.events import Event, TestedModel, Unsealed
from asia.ledger.looks import later_words
from asia.ledger.run import open_run
from asia.ledger.view import Experiment, SearchView
from asia.presentation.table import error_value
from asia.problem.metrics import MEE, find_metric, metric_label
from asia.problem.problem import Problem
from asia.problem.protocol import EarlyStopping, ShownResidual
from asia.report.comparison import (
    ArmCurves,
    ArmsPicture,
    BenchPictures,
    ComparedValue,
    Curve,
    PublishedMee,
)
from asia.report.files import draw_bench
from asia.report.published import leaderboard, official_figures, read_board
from asia.search.run import prepare, search
from asia.search.unsealing import unseal

# Published results of the paper on its two benchmarks.


@dataclass(frozen=True)
class PaperV:
    """V of one model in the paper."""

    model: str
    value: float
    """V, with validation early stopping."""
    row: str | None = None
    """Key of our row for comparison; None without one."""


@dataclass(frozen=True)
class PaperTest:
    """Test error of one model in the paper, in the unit of the output."""

    model: str
    value: float


class GroupErrors(NamedTuple):
    """Mean Euclidean Error of one output group after 10 and 50 samples, and summed over 1 to 50."""

    group: str
    h10: float
    h50: float
    total: float


@dataclass(frozen=True)
class PaperMee:
    """One row of the paper's table of Mean Euclidean Errors."""

    model: str
    groups: tuple[GroupErrors, ...]


@dataclass(frozen=True)
class Paper:
    """The paper's figures on one problem."""

    experiments: int
    references: tuple[str, ...]
    """Names of the candidates that rebuild its own configurations."""
    values: tuple[PaperV, ...]
    """Its values of V."""
    test: tuple[PaperTest, ...] = ()
    """Its test errors in the unit of the output."""
    mee: tuple[PaperMee, ...] = ()
    """Its mean Euclidean errors on the test."""
    protocol: str = ""
    """Caveats of a comparison of test figures."""


def paper(problem_name: str) -> Paper | None:
    """The paper's figures on a built-in problem; None when it has none."""
    text = ((PACKAGE / "assurance" / "bench") / "paper.toml").read_text("utf-8")
    return TypeAdapter(dict[str, Paper]).validate_python(tomllib.loads(text)).get(problem_name)


# Plan of a comparison: its searches and their budgets.


QUICK_EXPERIMENTS = 3
_QUICK_SECONDS = 120.0
_REFERENCE_SECONDS = 900.0
# Arms are compared at equal budget: none may stop because it found nothing for a while.
_PATIENCE = 100_000

SETTINGS: tuple[EarlyStopping, ...] = ("inner", "validation")


@dataclass(frozen=True)
class Arm:
    """One agent in a comparison."""

    name: str
    """Name in `--arms` and in the names of its runs."""
    label: str
    """Name in tables and pictures."""
    make: Callable[[], Agent]
    """Makes the agent, a new one for each search."""
    fixed: int | None = None
    """Number of fixed candidates that it evaluates, and no more, only if early stopping sees the
    validation fold; None for an agent that searches.
    """
    settings: Mapping[str, str] = field(default_factory=dict[str, str], hash=False)
    """Recorded settings of the agent."""


@dataclass(frozen=True)
class ComparisonPlan:
    """Arms, settings and budget of a comparison."""

    problem: Problem
    arms: tuple[Arm, ...]
    """The agents, each of them once."""
    seeds: tuple[int, ...]
    """Seeds; one search for each arm, setting and seed."""
    runs: Path
    """The directory of the runs."""
    settings: tuple[EarlyStopping, ...] = SETTINGS
    """Settings of early stopping, never two of them in one table."""
    experiments: int | None = None
    """Experiments of each search; None for the paper's number, else the problem's."""
    paper: Paper | None = None
    """The paper's figures; None for problems that it does not treat."""
    quick: bool = False
    """A few experiments with short fits, to see that everything works."""
    word: Literal["bench", "compare"] = "bench"
    """`compare`: agents against each other (`asia bench agents`), where no test is declared."""

    def __post_init__(self) -> None:
        for what, given in (
            ("arm", [a.name for a in self.arms]),
            ("seed", list(self.seeds)),
            ("early-stopping setting", list(self.settings)),
        ):
            if not given or len(set(given)) < len(given):
                text = ", ".join(str(g) for g in given) or "none"
                raise UserError(f"a comparison needs every {what} once, got: {text}")

    @property
    def name(self) -> str:
        """`bench-PROBLEM`, `compare-PROBLEM`: the directory of the results."""
        return f"{self.word}-{self.problem.name}" + ("-quick" if self.quick else "")

    @property
    def directory(self) -> Path:
        """Folder of tables and pictures."""
        return self.runs / self.name

    @property
    def budget(self) -> int:
        """Experiments of each search."""
        if self.experiments is not None:
            return self.experiments
        if self.quick:
            return QUICK_EXPERIMENTS
        return self.paper.experiments if self.paper else self.problem.budget.experiments

    @property
    def searches(self) -> tuple[PlannedRun, ...]:
        """Searches in order: the honest setting first, the expert before the controls."""
        runs: list[PlannedRun] = []
        for setting, seed, arm in itertools.product(self.settings, self.seeds, self.arms):
            budget = replace(self.problem.budget, experiments=self.budget, patience=_PATIENCE)
            seconds = budget.fit_seconds
            if arm.fixed is not None:
                if setting != "validation":
                    continue
                seconds = max(seconds, _REFERENCE_SECONDS)
                budget = replace(budget, experiments=1 + arm.fixed, fit_seconds=seconds)
            elif self.quick:
                budget = replace(budget, fit_seconds=min(seconds, _QUICK_SECONDS))
            rule = replace(self.problem.protocol, early_stopping=setting)
            problem = replace(self.problem, protocol=rule, budget=budget)
            name = f"{self.name}-{arm.name}-{setting}-s{seed}"
            runs.append(PlannedRun(name, arm, setting, seed, problem))
        return tuple(runs)

    @property
    def candidate_for_test(self) -> str | None:
        """Name of the run whose test may be opened: the expert's with the first seed, in the
        honest setting where there is one. None without an expert and among agents compared."""
        if self.word == "compare":
            return None
        experts = (s for s in self.searches if s.arm.name == "expert")
        return next((s.name for s in experts), None)


@dataclass(frozen=True)
class PlannedRun:
    """One search of a comparison."""

    name: str
    arm: Arm
    setting: EarlyStopping
    seed: int
    problem: Problem
    """The problem with the protocol and budget of this search."""


def select_arms(arms: Sequence[Arm], names: Sequence[str] | None) -> tuple[Arm, ...]:
    """The arms of these names, all when None. Raises UserError for an unknown name."""
    if names is None:
        return tuple(arms)
    known = {arm.name: arm for arm in arms}
    for name in names:
        if name not in known:
            raise UserError(f"no arm '{name}'; there is: {', '.join(known)}")
    return tuple(known[name] for name in names)


# The arms of a comparison with the paper, whose own configurations are fixed candidates.


TITLES = {"rnn4": "RNN-4", "ltc64": "LTC/CfC-64"}


@dataclass(frozen=True)
class FixedAgent:
    """Proposes given candidates in order: (title, source) pairs."""

    candidates: tuple[tuple[str, str], ...]
    name: str = "references"

    def propose(self, view: AgentView) -> Proposal | None:
        """The next one; None after the last."""
        done = len(view.trials) - 1
        if done >= len(self.candidates):
            return None
        title, source = self.candidates[done]
        return Proposal(
            source=source,
            family="reference",
            title=title,
            hypothesis="The paper's configuration and recipe, rebuilt.",
            expected="The V that the paper reports, within the spread over seeds.",
        )


def reference_agent(names: tuple[str, ...]) -> FixedAgent:
    """The reference candidates of these names, see `TITLES`."""
    folder = (PACKAGE / "assurance" / "bench") / "candidates"
    return FixedAgent(tuple((TITLES[n], (folder / f"{n}.py").read_text("utf-8")) for n in names))


def make_arms(paper: Paper | None) -> tuple[Arm, ...]:
    """Return the arms that search, and the references if the paper has some."""
    searches = (
        Arm("expert", "expert", partial(make_agent, "expert")),
        Arm("random", "random, library space", partial(make_agent, "random")),
        Arm("random-paper", "random, paper's space", partial(make_agent, "random", "paper")),
    )
    if paper is None or not paper.references:
        return searches
    names = paper.references
    return (*searches, Arm("references", "references", partial(reference_agent, names), len(names)))


# Declaration of the run whose sealed test may be opened, written before its search begins.


def declare(plan: ComparisonPlan) -> str | None:
    """Return the name of the declared run, written to `bench.json` on the first call.

    The declaration is final.

    Returns:
        The name; None if the plan has no expert, or if the run had begun before a declaration.

    Raises:
        UserError: the file cannot be read or belongs to another problem.
    """
    path, problem = plan.directory / "bench.json", plan.problem.name
    if path.is_file():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(f"cannot read {path}: {error}") from error
        declared = found.get("declared") if isinstance(found, dict) else None
        if not isinstance(declared, str) or found.get("problem") != problem:
            raise UserError(f"{path} does not declare a run of problem '{problem}': put it back")
        return declared
    name = plan.candidate_for_test
    if name is None or (plan.runs / name / "ledger.jsonl").exists():
        return None
    text = json.dumps({"problem": problem, "declared": name}, indent=2)
    write_whole(path, f"{text}\n".encode())
    return name


def require_declared(plan: ComparisonPlan, declared: str | None) -> str:
    """The run to unseal after the searches of `plan`. Raises UserError when there is none."""
    if plan.quick:
        raise UserError(
            "--unseal with --quick: the sealed test is opened once, for a full comparison; leave "
            "one of them out"
        )
    if declared is None:
        raise UserError(
            "--unseal: no run was declared before its search began (the expert's with the first "
            "seed is); start the comparison with the expert in another --runs"
        )
    if declared not in {search.name for search in plan.searches}:
        raise UserError(
            f"--unseal: run '{declared}' was declared for the sealed test, and this comparison "
            "does not contain it: add its seed, arm and early-stopping setting"
        )
    return declared


# V of everything in a comparison, one early-stopping setting at a time.


@dataclass(frozen=True)
class FinishedSearch:
    """A search of the comparison with the results from its ledger."""

    planned: PlannedRun
    view: SearchView
    """Its ledger, replayed."""


@dataclass(frozen=True)
class Row:
    """V of one model or search over the seeds."""

    key: str
    """Name in JSON and in the paper's figures."""
    model: str
    values: tuple[float, ...]
    """V of every run that has a score, in order of the seeds."""
    runs: int
    """Number of runs, with a score or without."""
    paper: float | None = None
    """V in the paper; None where it reports none, or measured it under another setting of early
    stopping."""
    scores_seen: int = 0
    """Maximum number of times that a fit received its score on the held-out part in one run."""

    @property
    def median(self) -> float | None:
        """Over the runs that have a score."""
        return statistics.median(self.values) if self.values else None


@dataclass(frozen=True)
class Reached:
    """Experiments that `arm`, the expert or the first agent compared, needed to come to the best V
    of a control with the same seed; None where it did not, or where the control has no score."""

    arm: str
    """The arm whose experiments are counted."""
    control: str
    """The arm whose best V is to be reached."""
    seeds: tuple[int, ...]
    """The seeds that both were run with."""
    experiments: tuple[int | None, ...]
    """Number of experiments for each seed; None if V was not reached."""


@dataclass(frozen=True)
class Comparison:
    """Everything measured under one early-stopping setting."""

    setting: EarlyStopping
    rows: tuple[Row, ...]
    """Reference models, baseline, rebuilt candidates and searches."""
    reached: tuple[Reached, ...]
    """Number of experiments of the first arm to reach the best V of each other arm."""
    residuals: ShownResidual = "train"
    """Residuals that the agents were shown."""


def compare(
    setting: EarlyStopping, runs: Sequence[FinishedSearch], paper: Paper | None
) -> Comparison:
    """Compute the rows of one setting; `runs` of other settings are ignored."""
    own = [run for run in runs if run.planned.setting == setting]
    rows: list[Row] = []
    # References and baseline are the same in every run of a seed; the linear model may depend on
    # the seed.
    first = list({run.planned.seed: run for run in reversed(own)}.values())[::-1]
    outcomes = [{r.name: r.outcome for r in run.view.references} for run in first]
    for name in dict.fromkeys(name for of_seed in outcomes for name in of_seed):
        found = [of_seed.get(name) for of_seed in outcomes]
        values = tuple(outcome.value for outcome in found if isinstance(outcome, Score))
        rows.append(Row(name, name, values, len(first)))
    if first:
        experiments = [run.view.experiment(1) for run in first if run.view.experiments]
        rows.append(_row("baseline", "baseline of the problem", experiments, len(first)))
    fixed = [run for run in own if run.planned.arm.fixed is not None]
    keys = {title: key for key, title in TITLES.items()}
    for title in dict.fromkeys(e.proposed.title for r in fixed for e in r.view.experiments[1:]):
        same = [e for run in fixed for e in run.view.experiments if e.proposed.title == title]
        rows.append(_row(keys.get(title, title), f"{title}, rebuilt", same, len(fixed)))
    by_arm: dict[Arm, list[FinishedSearch]] = {}
    for run in own:
        if run.planned.arm.fixed is None:
            by_arm.setdefault(run.planned.arm, []).append(run)
    for arm, searches in reversed(by_arm.items()):
        best = [run.view.best for run in searches if run.view.best is not None]
        most = max(len(run.view.finished) for run in searches)
        rows.append(_row(arm.name, f"{arm.label}, best of {most}", best, len(searches)))
    if setting == "validation":
        values_of_paper = paper.values if paper else ()
        published = {v.row: v.value for v in values_of_paper if v.row}
        rows = [replace(row, paper=published.get(row.key)) for row in rows]
        ours = {row.key for row in rows}
        rows += [
            Row(v.row or v.model, f"paper only: {v.model}", (), 0, v.value)
            for v in values_of_paper
            if v.row not in ours
        ]
    views = {
        arm.name: {run.planned.seed: run.view for run in searches}
        for arm, searches in by_arm.items()
    }
    shown = any(run.view.started.residuals == "held_out" for run in own)
    return Comparison(setting, tuple(rows), _reached(views), "held_out" if shown else "train")


def _row(key: str, model: str, experiments: Sequence[Experiment], runs: int) -> Row:
    values = tuple(e.score.value for e in experiments if e.score is not None)
    seen = [e.result.validation_scores for e in experiments if e.result is not None]
    return Row(key, model, values, runs, scores_seen=max(seen, default=0))


def _reached(views: Mapping[str, Mapping[int, SearchView]]) -> tuple[Reached, ...]:
    """Count the experiments to the best V of each control, from the searches by arm and seed."""
    arm = "expert" if "expert" in views else next(iter(views), "")
    answer: list[Reached] = []
    for control, of_control in views.items():
        seeds = tuple(seed for seed in views[arm] if seed in of_control)
        if control == arm or not seeds:
            continue
        counts: list[int | None] = []
        for seed in seeds:
            goal = of_control[seed].best_value
            tried = (e for e in views[arm][seed].finished if not e.unconfirmed)
            scored = ((e.number, e.score.value) for e in tried if e.score)
            counts.append(next((n for n, v in scored if goal is not None and v <= goal), None))
        answer.append(Reached(arm, control, seeds, tuple(counts)))
    return tuple(answer)


# Tables for people: aligned Markdown that reads as well on a terminal.


_TITLES: dict[EarlyStopping, str] = {
    "inner": "V with inner early stopping: nothing of the held-out fold is seen in training",
    "validation": "V with validation early stopping, as in the paper: training asks for its score "
    "on the held-out fold, so V is not leak-free",
}
_SHOWN: dict[ShownResidual, str] = {
    "train": "",
    "held_out": "; agents saw residuals of the held-out folds",
}
_NOTHING = "-"


@dataclass(frozen=True)
class TextTable:
    """Cells as text; the first column is left-aligned, the others right."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    """Cells, as many in each row as there are heads."""
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Title, rows and notes."""
        # Names of arms and signals neither end a row nor make a column.
        cells = [
            tuple(printable_line(text).replace("|", "\\|") for text in row)
            for row in (self.header, *self.rows)
        ]
        widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
        rule = ["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])]
        lines: list[str] = []
        for first, *rest in (cells[0], rule, *cells[1:]):
            right = [text.rjust(w) for text, w in zip(rest, widths[1:], strict=True)]
            lines.append(f"| {' | '.join([first.ljust(widths[0]), *right])} |")
        notes = [f"\n{note}" for note in self.notes]
        return "\n".join([f"## {self.title}", "", *lines, *notes]) + "\n"


def comparison_table(comparison: Comparison, paper: Paper | None) -> TextTable:
    """Write V of every row. The paper's column is only in the table of its own setting."""
    validation = comparison.setting == "validation"
    header = ("model", "V", "lowest", "highest", "runs")
    header += ("scores seen",) if validation else ()
    header += ("V paper",) if validation and paper is not None else ()
    rows: list[tuple[str, ...]] = []
    for row in comparison.rows:
        scored = len(row.values)
        runs = str(row.runs) if scored == row.runs else f"{scored} of {row.runs} scored"
        low, high = min(row.values, default=None), max(row.values, default=None)
        cells = [_number(row.median), _number(low), _number(high), runs, str(row.scores_seen)]
        cells = [row.model, *(cells if row.runs else [_NOTHING] * 5), _number(row.paper)]
        rows.append(tuple(cells[: len(header)]))
    notes: list[str] = []
    if any(row.runs > 1 for row in comparison.rows):
        notes.append("V is the median over the runs, one a seed.")
    for reached in comparison.reached:
        each = ", ".join(
            f"seed {seed}: {'not reached' if count is None else count}"
            for seed, count in zip(reached.seeds, reached.experiments, strict=True)
        )
        counts = [c for c in reached.experiments if c is not None]
        middle = f"; median {statistics.median(counts):g}" if len(counts) > 1 else ""
        notes.append(
            f"Experiments the {reached.arm} needed to reach the best V of {reached.control}: "
            f"{each}{middle}"
        )
    if validation:
        notes.append("Scores seen: number of held-out scores that the fits of one V received.")
    elif paper is not None:
        values = ", ".join(f"{v.model} {v.value:.3f}" for v in paper.values)
        notes.append(
            f"Not comparable, measured with validation early stopping in the paper: {values}."
        )
    return TextTable(
        _TITLES[comparison.setting] + _SHOWN[comparison.residuals],
        header,
        tuple(rows),
        tuple(notes),
    )


def _number(value: float | None) -> str:
    return _NOTHING if value is None else error_value(value)


# Agents against each other, paired by seed.


def paired_table(runs: Sequence[FinishedSearch]) -> TextTable | None:
    """Return the paired comparison of each two agents; None for one agent.

    Columns: number of seeds with which the first is better, median ratio of V, and the exact
    two-sided p of Wilcoxon's signed-rank test on the logarithms.
    """
    names = list(dict.fromkeys(run.planned.arm.name for run in runs))
    best = {(run.planned.arm.name, run.planned.seed): run.view.best_value for run in runs}
    seeds = sorted({run.planned.seed for run in runs})
    rows: list[tuple[str, ...]] = []
    for first, second in itertools.combinations(names, 2):
        pairs = [(best.get((first, s)), best.get((second, s))) for s in seeds]
        ratios = [a / b for a, b in pairs if a is not None and b is not None]
        better, ratio, p = _NOTHING, _NOTHING, _NOTHING
        if ratios:
            better = f"{sum(r < 1 for r in ratios)} of {len(ratios)}"
            ratio = error_value(statistics.median(ratios))
        if any(r != 1 for r in ratios):
            test: Any = wilcoxon(np.log(ratios), method="exact")
            p = f"{float(test.pvalue):.2g}"
        rows.append((f"{first} : {second}", str(len(ratios)), better, ratio, p))
    if not rows:
        return None
    header = ("pair", "seeds", "first better", "median V ratio", "p")
    notes = [
        "V ratio: first over second, below 1 where the first is better. p: two-sided signed-rank "
        f"test over the seeds; with {len(seeds)} it cannot be below "
        f"{min(1.0, 2.0 ** (1 - len(seeds))):.2g}."
    ]
    if len(seeds) < 6:
        notes.append("With fewer than 6 seeds no difference can be significant at 5 %.")
    return TextTable("Paired by seed", header, tuple(rows), tuple(notes))


# Test result of the declared run, compared with published results.


@dataclass(frozen=True)
class TestResult:
    """The test result of the declared run."""

    run: str
    record: Unsealed
    """The scores, as the ledger keeps them."""
    opened_before: tuple[str, ...]
    """Other runs that had opened the same test."""

    @property
    def models(self) -> tuple[tuple[str, TestedModel | Failure], ...]:
        """The ensemble of the fold models, and the refit and the stack where there are some."""
        named = (
            ("ours, ensemble of the fold models", self.record.ensemble),
            ("ours, refitted on all data", self.record.refit),
            ("ours, stack of several experiments", self.record.stack),
        )
        return tuple((name, model) for name, model in named if model is not None)


def read_test(directory: Path) -> TestResult | None:
    """Read the test result from the run's ledger; None while its test is sealed. Opens nothing."""
    try:
        view = open_run(directory).view
    except UserError:
        return None
    if view.unsealed is None:
        return None
    before = view.unsealing.opened_before if view.unsealing else ()
    return TestResult(directory.name, view.unsealed, before)


def test_tables(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None
) -> tuple[TextTable, ...]:
    """Write one table for each test metric of the problem, ours next to the published results.

    Args:
        plan: the comparison.
        declared: the run whose test may be opened.
        test: its test result.
    """
    if plan.problem.test.source is None:
        return ()
    tables = [
        _mee_table(plan, declared, test)
        if metric == MEE
        else _figures_table(plan, declared, test)
        if metric == "rmse" and plan.problem.protocol.test.unit is not None
        else _error_table(plan, declared, test, metric)
        for metric in plan.problem.protocol.test.metrics
    ]
    return tuple(table for table in tables if test is not None or len(table.rows) > 1)


def _error_table(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None, metric: str
) -> TextTable:
    units = {find_metric(metric).unit_of(s.unit) for s in plan.problem.outputs}
    unit = f" [{units.pop()}]" if len(units) == 1 and units != {""} else ""

    def cells(model: TestedModel) -> tuple[str, ...]:
        return tuple(error_value(s.value) for s in model.scores if s.metric == metric)

    rows = [(model, own[0]) for model, own in _ours(test, 1, cells)]
    notes = _notes(declared, test)
    if metric == "rmse" and plan.paper is not None:
        rows += [(row.model, error_value(row.value)) for row in plan.paper.test]
        # A user's own data may have a benchmark's name.
        entries = leaderboard(plan.problem.name) if plan.problem.data.public else ()
        if entries:
            ordered = sorted(entries, key=lambda e: e.test_rmse)
            rows += [
                (f"published {e.year}: {e.method}", error_value(e.test_rmse)) for e in ordered[:3]
            ]
            middle = statistics.median(e.test_rmse for e in entries)
            rows.append((f"median of {len(entries)} published", error_value(middle)))
        ensemble = test.record.ensemble if test is not None else None
        scores = ensemble.scores if isinstance(ensemble, TestedModel) else ()
        ours = next((s.value for s in scores if s.metric == "rmse"), None)
        if entries and ours is not None:
            lower = sum(e.test_rmse < ours for e in entries)
            notes.append(
                f"{lower} of {len(entries)} published results have a lower test RMSE than ours."
            )
        notes.append(plan.paper.protocol)
    label = metric_label(metric)
    header = ("model", f"test {label}{unit}")
    return TextTable(f"Sealed test: {label}", header, tuple(rows), tuple(notes))


def _figures_table(
    plan: ComparisonPlan, declared: str | None, test: TestResult | None
) -> TextTable:
    """The official figures, each on its own and none over all records."""
    problem = plan.problem
    board = read_board(problem, None)
    named = list(board.names)
    if test is not None:
        models = [m for _, m in test.models if not isinstance(m, Failure)]
        named = [f.name for m in models[:1] for f in official_figures(problem, test.record, m)]

    def cells(model: TestedModel) -> tuple[str, ...]:
        assert test is not None
        found = official_figures(problem, test.record, model)
        return tuple(error_value(figure.value) for figure in found)

    names = named or ["test"]
    rows = [(model, *own) for model, own in _ours(test, len(names), cells)]
    for k, name in enumerate(names):
        values = [v for e in board.entries if k < len(e.figures) and (v := e.figures[k])]
        if values:
            best = [error_value(min(values)) if i == k else "-" for i in range(len(names))]
            rows.append((f"lowest of {len(values)} published, {name}", *best))
    title = f"Sealed test: RMSE [{board.unit}]"
    return TextTable(title, ("model", *names), tuple(rows), tuple(_notes(declared, test)))


def _mee_table(plan: ComparisonPlan, declared: str | None, test: TestResult | None) -> TextTable:
    rule = plan.problem.protocol.test
    horizons = rule.horizons or (plan.problem.protocol.horizon,)
    names = [f"h{h}" for h in horizons]
    header = [f"{group.name} {name}" for group in rule.groups for name in (*names, "sum")]

    def cells(model: TestedModel) -> tuple[str, ...]:
        assert model.mee is not None
        groups = model.mee.by_group().values()
        return tuple(f"{value:.4g}" for group in groups for value in group.values())

    rows = [(model, *own) for model, own in _ours(test, len(header), cells)]
    notes = _notes(declared, test)
    if plan.paper is not None:
        for row in plan.paper.mee:
            errors = [v for g in row.groups for v in (g.h10, g.h50, g.total)]
            rows.append((row.model, *(f"{v:.4g}" for v in errors)))
        notes.append(plan.paper.protocol)
    title = "Sealed test: Mean Euclidean Error by output group, after so many samples and summed"
    return TextTable(title, ("model", *header), tuple(rows), tuple(notes))


def _ours(
    test: TestResult | None, width: int, cells: Callable[[TestedModel], tuple[str, ...]]
) -> list[tuple[str, tuple[str, ...]]]:
    """Our models with their cells; `sealed` in each while the test is."""
    if test is None:
        return [("ours", ("sealed",) * width)]
    rows: list[tuple[str, tuple[str, ...]]] = []
    for name, model in test.models:
        if isinstance(model, Failure):
            rows.append((f"{name}: {model.reason.value}", ("-",) * width))
        else:
            rows.append((name, cells(model)))
    return rows


def _notes(declared: str | None, test: TestResult | None) -> list[str]:
    if test is None and declared is None:
        return ["The test is sealed, and no run is declared for it: the expert is not compared."]
    if test is None:
        return [
            f"The test is sealed; --unseal opens that of run {declared}, once, after the last "
            "search."
        ]
    notes = [f"Run {test.run}, experiment {test.record.experiment}, declared before its search."]
    if words := later_words(test.opened_before):
        notes.append(f"{words[0].upper()}{words[1:]}.")
    return notes


# Pictures of a comparison, each early-stopping setting in its own.


_WORDS: dict[EarlyStopping, str] = {
    "inner": "inner early stopping",
    "validation": "validation early stopping, as in the paper",
}


def draw(
    plan: ComparisonPlan, finished: Sequence[FinishedSearch], test: TestResult | None
) -> tuple[Path, ...]:
    """Draw the progress of the expert's first search and the comparison of the arms for each
    setting; with an opened test, its results next to the published ones.
    """
    paper = plan.paper
    sides: list[ArmsPicture] = []
    progress: list[tuple[str, Path]] = []
    for setting in plan.settings:
        own = [run for run in finished if run.planned.setting == setting]
        experts = [run for run in own if run.planned.arm.name == "expert"]
        if experts:
            progress.append((f"progress-{setting}", plan.runs / experts[0].planned.name))
        curves: dict[Arm, list[Curve]] = {}
        for run in own:
            if run.planned.arm.fixed is None:
                values = tuple(e.value for e in run.view.finished)
                curves.setdefault(run.planned.arm, []).append(Curve(values))
        if not curves:
            continue
        # The linear model, and the paper's searches where they were measured alike.
        levels = [
            ComparedValue(LINEAR_REFERENCE, reference.outcome.value)
            for reference in own[0].view.references
            if reference.name == LINEAR_REFERENCE and isinstance(reference.outcome, Score)
        ]
        if setting == "validation" and paper is not None:
            alike = [v for v in paper.values if v.row in ("expert", "random-paper")]
            levels += [ComparedValue(f"paper: {v.model}", v.value) for v in alike]
        bench = plan.word == "bench"
        agents = "expert against random search" if bench else "agents at equal budgets"
        picture = ArmsPicture(
            name=f"arms-{setting}",
            title=f"{plan.problem.name}: {agents}, {_WORDS[setting]}",
            sides=tuple(ArmCurves(arm.label, tuple(found)) for arm, found in curves.items()),
            levels=tuple(levels),
            metric=plan.problem.protocol.metric,
        )
        sides.append(picture)
    pictures = BenchPictures(
        progress=tuple(progress),
        sides=tuple(sides),
        opened=plan.runs / test.run if test else None,
        test_mark=("paper", paper.test[0].value) if paper and paper.test else None,
        mee=tuple(
            PublishedMee(
                row.model,
                tuple((g.group, h, v) for g in row.groups for h, v in ((10, g.h10), (50, g.h50))),
            )
            for row in (paper.mee if paper else ())
        ),
        caption=paper.protocol if paper else "",
    )
    return draw_bench(pictures, plan.directory)


# Run every search of a comparison, open the declared test when asked to, write the results.


class Watcher(Protocol):
    """Listens to a comparison."""

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Search `number` of `total` is about to begin, or to be read when it is finished."""
        ...

    def on_event(self, event: Event, view: SearchView) -> None:
        """An event of that search was written to its ledger."""
        ...

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """Handle the end of one search."""
        ...


@dataclass(frozen=True)
class BenchResult:
    """A finished comparison."""

    comparisons: tuple[Comparison, ...]
    """Measured results, one comparison for each early-stopping setting."""
    tables: tuple[TextTable, ...]
    """The same, and the test, for people."""
    declared: str | None
    """The run whose test may be opened."""
    test: TestResult | None
    """Test result of the declared run; None while its test is sealed."""
    document: Path
    pictures: tuple[Path, ...]


def bench(
    plan: ComparisonPlan,
    watcher: Watcher,
    *,
    open_test: bool = False,
    process_consent: bool = False,
) -> BenchResult:
    """Searches that exist are finished, not repeated: killed anywhere, the same call goes on.

    open_test: after the last search, score the declared run on the sealed test; no other run's test
    is ever opened; process_consent: as in `unseal`. Raises UserError for anything the caller can
    mend.
    """
    declared = declare(plan)
    to_open = require_declared(plan, declared) if open_test else None
    planned = plan.searches
    finished: list[FinishedSearch] = []
    for number, run in enumerate(planned, start=1):
        watcher.on_run(run, number, len(planned))
        agent = run.arm.make()
        ready = prepare(
            run.problem,
            agent.name,
            seed=run.seed,
            runs=plan.runs,
            name=run.name,
            agent_settings=run.arm.settings,
        )
        search(ready, agent, watcher.on_event, lambda view: None)
        view = open_run(ready.directory).view
        watcher.on_end(run, view)
        finished.append(FinishedSearch(run, view))
        _write(plan, _tables(plan, finished, declared, None))
    if to_open is not None:
        unseal(plan.runs / to_open, process_consent=process_consent)
    names = {run.name for run in planned}
    test = read_test(plan.runs / declared) if declared in names and declared else None
    tables = _tables(plan, finished, declared, test)
    return BenchResult(
        comparisons=tuple(compare(s, finished, plan.paper) for s in plan.settings),
        tables=tables,
        declared=declared,
        test=test,
        document=_write(plan, tables),
        pictures=draw(plan, finished, test),
    )


def _tables(
    plan: ComparisonPlan,
    runs: Sequence[FinishedSearch],
    declared: str | None,
    test: TestResult | None,
) -> tuple[TextTable, ...]:
    done = [compare(setting, runs, plan.paper) for setting in plan.settings]
    shown = [comparison_table(c, plan.paper) for c in done if c.rows]
    if plan.word == "compare":
        paired = paired_table(runs)
        return (*shown, *([paired] if paired is not None else []))
    return (*shown, *test_tables(plan, declared, test))


def _write(plan: ComparisonPlan, tables: tuple[TextTable, ...]) -> Path:
    path = plan.directory / f"{plan.problem.name}.md"
    head = f"# {plan.problem.name}: {plan.budget} experiments a search, seeds "
    head += ", ".join(str(seed) for seed in plan.seeds)
    head += "\n\nQuick: short fits, too few experiments to compare.\n" if plan.quick else "\n"
    text = "\n".join([head, *(t.markdown() for t in tables)])
    write_whole(path, text.encode(), durable=False)
    return path


# A comparison as JSON, for scripts.


def result_object(result: BenchResult) -> dict[str, Any]:
    """`comparisons` holds one object an early-stopping setting, never both in one; `test` is null
    while the declared run is sealed. Each model of the test has the value of every metric, or the
    reason for its absence."""

    def model_object(model: TestedModel | Failure | None) -> dict[str, Any] | None:
        if model is None:
            return None
        if isinstance(model, Failure):
            return {"failure": model.reason.value, "advice": model.advice}
        values: dict[str, Any] = {score.metric: score.value for score in model.scores}
        if model.mee is not None:
            values["mee"] = model.mee.by_group()
        return values

    test: dict[str, Any] | None = None
    if result.test is not None:
        record = result.test.record
        test = {
            "run": result.test.run,
            "experiment": record.experiment,
            "ensemble": model_object(record.ensemble),
            "refit": model_object(record.refit),
        }
    return {
        "comparisons": [
            {
                "early_stopping": comparison.setting,
                "rows": [{**asdict(row), "V": row.median} for row in comparison.rows],
                "reached": [
                    {
                        "control": r.control,
                        "seeds": list(r.seeds),
                        "experiments": list(r.experiments),
                    }
                    for r in comparison.reached
                ],
            }
            for comparison in result.comparisons
        ],
        "declared": result.declared,
        "test": test,
        "document": str(result.document),
        "pictures": [str(path) for path in result.pictures],
    }
