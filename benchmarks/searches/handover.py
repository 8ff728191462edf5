"""The model that the rule names, against the best of ensemble, refit and stack in hindsight.

    python benchmarks/searches/handover.py --out DIR [--jobs N] [--seeds 200,201,...]
        [--systems linear,duffing] [--experiments 5] [--folds 2] [--table]

Each search is on a synthetic system drawn with its seed, 1000 samples for even seeds and 400 for
odd ones, and ends with its sealed record opened: error of all three models against the measured
outputs and against the noise-free truth. DIR/results keeps a file a search. The same command goes
on with what is in DIR; --table prints the tables of what is there and searches nothing. The tables
end with what output bands held.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from asia.agents import make_agent
from asia.judge.sandbox.types import Isolation
from asia.ledger.artifacts import Store
from asia.ledger.events import TestedModel, Unsealed
from asia.ledger.run import open_run
from asia.problem.problem import Problem
from asia.search.run import prepare, search
from asia.search.unsealing import unseal
from harness import Brisk, option_parser, run_all, synthetic_problem, table, words
from systems import KINDS, Record, System, make_system

# A fit may take the problem's own time; the agent plans for less, which makes its fits short.
PLANNED_SECONDS = 6.0
SHORT, LONG = 400, 1000
FAR_OFF = 0.25
MODELS = "ensemble", "refit", "stack"


@dataclass(frozen=True)
class Task:
    """One search."""

    kind: str
    """The kind of system."""
    seed: int
    """Seed of the system and of the search."""
    experiments: int
    """The budget."""
    folds: int
    """How many contiguous folds."""
    out: Path
    """Folder of problems, runs and results."""

    @property
    def run(self) -> str:
        """Name of the run."""
        folds = "" if self.folds == 2 else f"-f{self.folds}"
        return f"{self.kind}-s{self.seed}-n{self.experiments}{folds}"

    @property
    def result(self) -> Path:
        """File with its result."""
        return self.out / "results" / f"{self.run}.json"


def main() -> None:
    """Make the searches that are not there yet, and print the tables."""
    options = _options()
    tasks = [
        Task(kind, seed, options.experiments, options.folds, options.out)
        for seed in options.seeds
        for kind in options.systems
    ]
    if not options.table:
        (options.out / "results").mkdir(parents=True, exist_ok=True)
        missing = [task for task in tasks if not task.result.exists()]
        for line in run_all(run_task, missing, options.jobs):
            print(line, file=sys.stderr, flush=True)
    print(tables([json.loads(t.result.read_text()) for t in tasks if t.result.exists()]))


def _options() -> argparse.Namespace:
    parser = option_parser(__doc__)
    parser.add_argument("--seeds", type=_numbers, default=list(range(200, 206)), metavar="A,B")
    parser.add_argument("--systems", default=list(KINDS), type=words(KINDS), metavar="A,B")
    parser.add_argument("--experiments", type=int, default=5)
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument("--table", action="store_true", help="search nothing")
    parser.add_argument("--out", type=Path, required=True, help="keep everything here, and resume")
    return parser.parse_args()


def _numbers(text: str) -> list[int]:
    return [int(one) for one in text.split(",")]


def run_task(task: Task) -> str:
    """The search from where it is, its sealed record opened; a line about it."""
    start = time.monotonic()
    system = _system(task)
    place = task.out / "problems" / f"{task.kind}-{task.seed}"
    problem = synthetic_problem(system, place, task.experiments)
    rule = problem.protocol
    rule = replace(rule, folds=replace(rule.folds, count=task.folds))
    problem = replace(problem, protocol=rule)
    agent = Brisk(make_agent("expert"), PLANNED_SECONDS)
    ready = prepare(
        problem, agent.name, seed=task.seed, runs=task.out / "runs", name=task.run,
        isolation=Isolation.PROCESS,
    )  # fmt: skip
    search(ready, agent, lambda *_: None, lambda _: None)
    if open_run(ready.directory).view.best is None:
        return f"{task.run}  no candidate has a score"
    opened = unseal(ready.directory, process_consent=True).record
    kept = _kept(task, problem, system, ready.directory, opened)
    task.result.write_text(json.dumps(kept))
    errors = ", ".join(f"{name} {error:.4g}" for name, error in kept["rmse"].items())
    return f"{task.run}  {kept['use']}  {errors}  {time.monotonic() - start:.0f} s"


def _system(task: Task) -> System:
    system = make_system(KINDS[task.kind], task.seed)
    count = SHORT if task.seed % 2 else LONG
    parts = system.train
    return replace(system, train=Record(parts.u[:count], parts.y[:count], parts.truth[:count]))


def _kept(
    task: Task, problem: Problem, system: System, directory: Path, opened: Unsealed
) -> dict[str, Any]:
    view = open_run(directory).view
    refitted, best = view.refitted, view.best
    assert refitted is not None
    assert best is not None
    models = {name: getattr(opened, name) for name in MODELS}
    tested = {name: m for name, m in models.items() if isinstance(m, TestedModel)}
    truth = system.test.truth[problem.protocol.past :]
    scale = problem.train[0].y.std(axis=0)
    simulated = {name: _simulated(directory, opened, m) for name, m in tested.items()}
    return {
        "run": task.run, "kind": task.kind, "seed": task.seed, "use": refitted.use,
        "family": best.proposed.family, "samples": len(problem.train[0]),
        "value": best.score.value if best.score else None,
        "stack": None if refitted.stack is None else asdict(refitted.stack),
        "rmse": {
            name: float(np.mean(np.asarray(m.scores[0].per_channel) / scale))
            for name, m in tested.items()
        },
        "truth": {
            name: float(np.mean(np.sqrt(np.mean((truth - y_hat) ** 2, axis=0)) / scale))
            for name, y_hat in simulated.items()
        },
        "noise": float(np.mean(system.noise_std / scale)),
        "bands": None if opened.bands is None else asdict(opened.bands),
    }  # fmt: skip


def _simulated(directory: Path, opened: Unsealed, model: TestedModel) -> np.ndarray:
    store = Store(directory / "artifacts")
    shapes = [(n, len(opened.channels)) for n in opened.lengths]
    return np.concatenate(store.get_arrays(model.y_hat, shapes))


def tables(found: Sequence[dict[str, Any]]) -> str:
    """The rule against hindsight, and the stack beside the best candidate."""
    lines = [
        f"{len(found)} searches. Loss: sealed error of the named model over that of the best of "
        "the three, less 1.",
        "",
    ]
    rows: list[list[str]] = []
    rules: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("the rule", _named),
        *((name, lambda one, name=name: name) for name in MODELS),
    ]
    for name, rule in rules:
        cells = [name, _counts([_there(one, rule(one)) for one in found])]
        for what in ("rmse", "truth"):
            losses = [_loss(one, rule(one), what) for one in found]
            cells += [f"{100 * median(losses):.1f} %", f"{100 * max(losses):.1f} %"]
        rows.append(cells)
    heads = "always", "named", "median loss, measured", "worst", "median loss, truth", "worst"
    lines.append(table(heads, rows))
    over = [one for one in found if _loss(one, _named(one), "rmse") > FAR_OFF]
    lines += ["", f"Loss of the rule above {100 * FAR_OFF:.0f} %, measured: {len(over)}."]
    lines += [f"- {one['run']}: {_named(one)}, {one['rmse']}" for one in over]
    stacked = [one for one in found if one["stack"]]
    lines += ["", *_stack_lines(stacked, len(found))]
    return "\n".join([*lines, "", *_band_lines([b for b in map(_bands, found) if b])])


def _bands(one: dict[str, Any]) -> dict[str, Any] | None:
    return one.get("bands")


def _band_lines(found: Sequence[dict[str, Any]]) -> list[str]:
    """Coverage of the output bands on the sealed records, everywhere and near the training data."""
    if not found:
        return ["No search kept output bands."]
    rows: list[list[str]] = []
    for region, low, high in (
        ("any", -1.0, 1.0), ("at most 2 %", -1.0, 0.02), ("2 to 10 %", 0.02, 0.1),
        ("above 10 %", 0.1, 1.0),
    ):  # fmt: skip
        held = [float(np.mean(b["covered"])) for b in found if low < b["outside"] <= high]
        if held:
            cells = [
                f"{100 * x:.1f} %" for x in (np.mean(held), median(held), min(held), max(held))
            ]
            rows.append([region, str(len(held)), *cells])
    heads = "outside the region of validity", "searches", "mean", "median", "lowest", "highest"
    head = f"Output bands of {found[0]['level']:.0%}, share of sealed samples that they held:"
    return [head, "", table(heads, rows)]


def _named(one: dict[str, Any]) -> str:
    return one["use"]


def _there(one: dict[str, Any], model: str) -> str:
    """The model, or the ensemble where the search has no such one."""
    return model if model in one["rmse"] else "ensemble"


def _loss(one: dict[str, Any], model: str, what: str) -> float:
    return one[what][_there(one, model)] / min(one[what].values()) - 1.0


def _counts(names: Sequence[str]) -> str:
    return ", ".join(f"{names.count(name)} {name}" for name in MODELS if name in names)


def _stack_lines(found: Sequence[dict[str, Any]], total: int) -> list[str]:
    if not found:
        return ["No search has a stack."]
    nested = [one["stack"]["value"] / one["value"] for one in found]
    sealed = [one["rmse"]["stack"] / one["rmse"]["ensemble"] for one in found]
    believed = [(n, s) for n, s in zip(nested, sealed, strict=True) if n < 1]
    flat = [one["rmse"]["stack"] / one["stack"]["value"] for one in found]
    winner = [one["rmse"]["ensemble"] / one["value"] for one in found]
    lines = [
        f"{len(found)} of {total} searches have a stack of more than one candidate.",
        f"Nested V of the stack over V of the best candidate: median {median(nested):.3f}.",
        f"Sealed error of the stack over that of the best candidate's ensemble: median "
        f"{median(sealed):.3f}, below 1 in {sum(s < 1 for s in sealed)}.",
        f"Sealed error over V: stack (nested) {median(flat):.3f}, winner {median(winner):.3f}.",
    ]
    if believed:
        better = sum(s < 1 for _, s in believed)
        lines.append(
            f"Where the nested V is below that of the best ({len(believed)}): sealed ratio median "
            f"{median(s for _, s in believed):.3f}, below 1 in {better}."
        )
    return lines


if __name__ == "__main__":
    main()
