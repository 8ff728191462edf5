"""Do lessons from other systems shorten a search, and do wrong ones harm it?

python benchmarks/searches/lessons.py --out DIR [--jobs 2] [--systems linear-0,duffing-1]
    [--arms without,with] [--experiments 10] [--ship FILE] [--lessons FILE]

The expert searches each system without lessons, then with the lessons of all other systems, with
those of all others the wrong way round, what helped harms, and with those of the systems of other
kinds only. The table says how many experiments each needs to come within a hundredth of the best
V without lessons, one more than the budget where it does not come there.

Candidates are the library's own, so they are fitted in this process, without a sandbox; one that
was fitted before, in whatever search, is not fitted again. The same command goes on where it was
interrupted; DIR/table.md has what there is so far. With --ship the lessons of the searches without
lessons are written; --lessons FILE is such a file for the arm `with`, on systems that it does not
hold.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import geometric_mean, mean
from typing import Any, Literal

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import numpy as np
from scipy.stats import binomtest

from asia.agents import AgentView, Effort, ExpertAgent, Proposal, Trial
from asia.agents.lessons import Lesson, decode_lessons, encode_lessons, learn
from asia.candidate import source_digest
from asia.data import Array
from asia.errors import CandidateError
from asia.evaluation import LINEAR, derive_seed, search_context
from asia.evaluation._requests import simulate_held_out, simulate_training
from asia.ledger import write_whole
from asia.problem.load import Problem, builtin_problems, load_problem
from asia.protocol import Fold, make_folds, whole
from asia.scoring import Diagnostics, Failure, FoldScore, combine, diagnose, score_fold
from asia.search import problem_facts
from asia.search.deciding.rules import EXPLORE_SHARE
from systems import KINDS, make_system, write_problem

Arm = Literal["without", "with", "misled", "other kinds"]
ARMS: tuple[Arm, ...] = ("without", "with", "misled", "other kinds")
NEAR = 1.01
SAMPLES = 500
FIT_SECONDS = 20.0
SEEDS = (0, 1)
_FAILURES = (CandidateError, ArithmeticError, ValueError, RuntimeError, TypeError)


@dataclass(frozen=True)
class Result:
    """What a candidate came to on one system."""

    value: float | None
    """V; None where it has no score."""
    folds: tuple[float, ...]
    """V of each fold."""
    diagnostics: tuple[Diagnostics, ...]
    """Residual analysis of each fold's training simulation."""
    seconds: float
    """Duration of the fits and simulations."""


@dataclass(frozen=True)
class Bench:
    """What is measured, and where it is kept."""

    out: Path
    """Folder of problems, compiled programs and results."""
    experiments: int
    """Budget of each search, the baseline included."""

    def problem(self, system: str) -> Problem:
        """The problem of a system `KIND-SEED`, written once; or a built-in one by its name."""
        if system in builtin_problems():
            return load_problem(system)
        kind, _, seed = system.rpartition("-")
        folder = self.out / "problems" / system
        if not (folder / "problem.toml").is_file():
            drawn = make_system(KINDS[kind], int(seed))
            parts = (
                replace(r, u=r.u[:SAMPLES], y=r.y[:SAMPLES], truth=r.truth[:SAMPLES])
                for r in (drawn.train, drawn.test)
            )
            train, test = parts
            write_problem(replace(drawn, train=train, test=test), folder, self.experiments)
        return load_problem(folder)

    def evaluated(self, problem: Problem, system: str, source: str) -> Result:
        """The result of a candidate, from the folder where it is known."""
        path = self.out / "results" / system / f"{source_digest(source)[:24]}.json"
        if path.is_file():
            said = json.loads(path.read_text("utf-8"))
            evidence = tuple(Diagnostics(**d) for d in said["diagnostics"])
            return Result(said["value"], tuple(said["folds"]), evidence, said["seconds"])
        result = _evaluate(problem, source)
        write_whole(path, json.dumps(asdict(result)).encode(), durable=False)
        return result


class _Fitted:
    """A fitted model as the evaluator asks it."""

    def __init__(self, model: Any) -> None:
        self._model = model

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        y_hat = np.asarray(self._model.simulate(past_u, past_y, u), dtype=np.float64)
        if not np.isfinite(y_hat).all():
            raise ArithmeticError("the simulation is not finite")
        return y_hat


def _evaluate(problem: Problem, source: str) -> Result:
    """As the evaluator does it, without its walls."""
    start = time.monotonic()
    try:
        folds = [
            _fold(problem, fold, source) for fold in make_folds(problem.train, problem.protocol)
        ]
    except _FAILURES as error:
        print(f"    {problem.name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return Result(None, (), (), time.monotonic() - start)
    outcome = combine([score for score, _ in folds])
    seconds = time.monotonic() - start
    if isinstance(outcome, Failure):
        return Result(None, (), (), seconds)
    values = tuple(fold.value for fold in outcome.folds)
    return Result(outcome.value, values, tuple(d for _, d in folds), seconds)


def _fold(problem: Problem, fold: Fold, source: str) -> tuple[FoldScore, Diagnostics]:
    rule = problem.protocol
    seed = derive_seed(derive_seed(0, "search"), fold.index, 0)
    context = replace(search_context(problem, seed), deadline=time.monotonic() + 3600.0)
    names: dict[str, Any] = {"__name__": "candidate"}
    exec(compile(source, "candidate.py", "exec"), names)
    model = _Fitted(names["fit"](fold.train, context))
    inside = whole(fold.train, rule)
    y_hat = simulate_held_out(model, fold.validation, rule.horizon)
    train_y_hat = simulate_training(model, inside, rule.horizon)
    score = score_fold([b.y for b in fold.validation], y_hat, fold.scale, rule.metric)
    train_y = [b.y for b in inside]
    train = score_fold(train_y, train_y_hat, fold.scale, rule.metric)
    found = diagnose([b.case.u for b in inside], train_y, train_y_hat, fold.scale, train.value)
    return score, found


def run_search(bench: Bench, system: str, lessons: Sequence[Lesson]) -> AgentView:
    """The expert's search, by the rules of the loop; the view at its end."""
    problem = bench.problem(system)
    facts = replace(problem_facts(problem), budget=Effort(bench.experiments, FIT_SECONDS))
    linear = bench.evaluated(problem, system, LINEAR).value
    agent, known = ExpertAgent(), set[str]()
    explored = max(2, round(EXPLORE_SHARE * bench.experiments))
    view = AgentView(
        facts,
        seed=0,
        phase="explore",
        trials=(),
        remaining=bench.experiments,
        is_known=lambda source: source_digest(source) in known,
        linear=linear,
        lessons=tuple(lessons),
    )
    proposal: Proposal | None = Proposal(LINEAR, "baseline", "baseline", "", "")
    while proposal is not None:
        result = bench.evaluated(problem, system, proposal.source)
        known.add(source_digest(proposal.source))
        trials = (*view.trials, _trial(proposal, view, result))
        left = bench.experiments - len(trials)
        phase = "explore" if len(trials) < explored else "refine"
        view = replace(view, trials=trials, remaining=left, phase=phase)
        proposal = agent.propose(view) if left else None
    return view


def _trial(proposal: Proposal, view: AgentView, result: Result) -> Trial:
    best = view.best.value if view.best else None
    better = result.value is not None and (best is None or result.value < best)
    return Trial(
        number=len(view.trials) + 1,
        parent=proposal.parent,
        phase=view.phase,
        family=proposal.family,
        title=proposal.title,
        hypothesis=proposal.hypothesis,
        expected=proposal.expected,
        source=proposal.source,
        status="invalid" if result.value is None else "keep" if better else "discard",
        value=result.value,
        folds=result.folds,
        failure="not_finite" if result.value is None else None,
        diagnostics=result.diagnostics,
    )


@dataclass(frozen=True)
class Searched:
    """What one search came to."""

    arm: Arm
    """Which lessons it had."""
    system: str
    """The system."""
    values: tuple[float | None, ...]
    """V of each experiment."""
    lessons: tuple[Lesson, ...]
    """What it taught."""

    @property
    def best(self) -> float:
        """The lowest V."""
        return min(v for v in self.values if v is not None)

    def reaches(self, target: float) -> int:
        """The experiment that came within `NEAR` of a V; one more than there are where none did."""
        near = (k for k, v in enumerate(self.values, 1) if v is not None and v <= NEAR * target)
        return next(near, len(self.values) + 1)


def searched(bench: Bench, arm: Arm, system: str, lessons: Sequence[Lesson]) -> Searched:
    """One search in a process of its own."""
    keep_programs(bench.out / "programs" / str(os.getpid() % 2**16))
    start = time.monotonic()
    view = run_search(bench, system, lessons)
    print(f"{arm:<12} {system:<22} {time.monotonic() - start:6.1f} s", file=sys.stderr, flush=True)
    return Searched(arm, system, tuple(t.value for t in view.trials), learn(view, system))


def keep_programs(folder: Path) -> None:
    """Programs that JAX compiled once are read again by the next search in this process."""
    import jax

    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")


def lessons_for(arm: Arm, system: str, known: Sequence[Searched]) -> list[Lesson]:
    """Those of the other systems, of systems of other kinds, or all of the others reversed."""
    kind = system.rpartition("-")[0]
    from_others = [
        lesson
        for one in known
        for lesson in one.lessons
        if one.system != system and (arm != "other kinds" or one.system.rpartition("-")[0] != kind)
    ]
    return [_reversed(one) for one in from_others] if arm == "misled" else from_others


def _reversed(lesson: Lesson) -> Lesson:
    """What helped harms, what failed helped."""
    return replace(lesson, gain=1.0 if lesson.gain is None else -lesson.gain)


def table(found: dict[tuple[Arm, str], Searched], wanted: Sequence[str]) -> str:
    """Markdown: experiments to the best V without lessons, and the lowest V over that."""
    heads = ["system", "best V without"]
    heads += [f"experiments, {arm}" for arm in ARMS] + [f"V ratio, {arm}" for arm in ARMS[1:]]
    lines = [heads, ["---"] * len(heads)]
    systems = [s for s in wanted if ("without", s) in found]
    for system in systems:
        old = found["without", system]
        row = [found.get((arm, system)) for arm in ARMS]
        counts = ["" if one is None else str(one.reaches(old.best)) for one in row]
        ratios = ["" if one is None else f"{one.best / old.best:.3f}" for one in row[1:]]
        lines.append([system, f"{old.best:.4g}", *counts, *ratios])
    lines.append(["**mean**", "", *_means(found, systems)])
    text = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    return "\n".join([text, "", *_comparisons(found, systems)])


def _means(found: dict[tuple[Arm, str], Searched], systems: Sequence[str]) -> Iterator[str]:
    """Of the experiments; geometric of the ratios."""
    for arm in ARMS:
        counts = [n for _, n in _counts(found, arm, systems)]
        yield f"{mean(counts):.2f}" if counts else ""
    for arm in ARMS[1:]:
        done = [s for s in systems if (arm, s) in found]
        ratios = [found[arm, s].best / found["without", s].best for s in done]
        yield f"{geometric_mean(ratios):.3f}" if ratios else ""


def _comparisons(found: dict[tuple[Arm, str], Searched], systems: Sequence[str]) -> Iterator[str]:
    for arm in ARMS[1:]:
        pairs = _counts(found, arm, systems)
        sooner, later = sum(b < a for a, b in pairs), sum(b > a for a, b in pairs)
        if pairs:
            decided = sooner + later
            p = binomtest(sooner, decided).pvalue if decided else 1.0
            yield (
                f"- {arm}: sooner on {sooner}, later on {later}, alike on "
                f"{len(pairs) - decided} systems; sign test p = {p:.2g}"
            )


def _counts(
    found: dict[tuple[Arm, str], Searched], arm: Arm, systems: Sequence[str]
) -> list[tuple[int, int]]:
    """Experiments to the best V without lessons: without them, and in this arm."""
    done = [(found["without", s], found[arm, s]) for s in systems if (arm, s) in found]
    return [(old.reaches(old.best), one.reaches(old.best)) for old, one in done]


def main() -> None:
    """Run the searches that are missing, and print the table after each arm."""
    options = _options()
    bench = Bench(options.out, options.experiments)
    found: dict[tuple[Arm, str], Searched] = {}
    processes = ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn"))
    with processes:
        for arm in options.arms:
            known = [one for (other, _), one in found.items() if other == "without"]
            given = options.lessons if arm == "with" else ()
            asked = [
                processes.submit(searched, bench, arm, s, given or lessons_for(arm, s, known))
                for s in options.systems
            ]
            for done in as_completed(asked):
                found[arm, done.result().system] = done.result()
                write_whole(options.out / "table.md", table(found, options.systems).encode())
    if options.ship:
        known = [found["without", system] for system in options.systems]
        write_whole(options.ship, encode_lessons([n for one in known for n in one.lessons]))
    print(table(found, options.systems))


def _read(path: str) -> tuple[Lesson, ...]:
    return decode_lessons(Path(path).read_bytes(), path)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    every = [f"{kind}-{seed}" for seed in SEEDS for kind in KINDS]
    parser.add_argument("--out", type=Path, required=True, help="keep everything here, and resume")
    parser.add_argument("--jobs", type=int, default=2, help="searches at the same time")
    parser.add_argument("--systems", type=lambda t: t.split(","), default=every, metavar="A-0,B-1")
    parser.add_argument("--arms", type=lambda t: t.split(","), default=ARMS, metavar="A,B")
    parser.add_argument("--lessons", type=_read, default=(), help="with these, in that arm")
    parser.add_argument("--experiments", type=int, default=10)
    parser.add_argument("--ship", type=Path, help="write the lessons of the first arm here")
    return parser.parse_args()


if __name__ == "__main__":
    main()
