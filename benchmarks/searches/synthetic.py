"""Identification on synthetic systems whose noise-free output is known.

python benchmarks/searches/synthetic.py [--systems linear,duffing] [--agents expert,random]
    [--experiments 10] [--seed 0] [--out DIR]

Every search runs through the library with folds in parallel, one search at a time. Finished parts
of an interrupted run are not redone when --out is given again. Progress goes to stderr, the table
as Markdown to stdout; with --figure the curves of best V so far, over the noise floor, median and
quartiles over the systems.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np

from asia.agents import make_agent
from asia.agents.registry import AGENTS
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.artifacts import Store
from asia.ledger.events import Evaluated, Event, TestedModel
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.run import prepare, search
from asia.search.unsealing import unseal
from harness import option_parser, table, words
from systems import KINDS, System, make_system, write_problem
from unfamiliar import UNFAMILIAR

KNOWN = KINDS | UNFAMILIAR
FLOOR = "simulated truth"
LINEAR = "linear model"


@dataclass(frozen=True)
class Found:
    """Result of one search. `ratio`: test error against the noise-free truth over the standard
    deviation of the noise, mean over the channels; None when no candidate had a score. `named`: the
    same of the model that the search names, and `use`, which one that is. `curve`: best V so far
    after each experiment, infinite before the first score."""

    linear: float | None
    floor: float | None
    best: float | None
    number: int | None
    family: str
    ratio: float | None
    failures: int
    seconds: float
    curve: tuple[float, ...] = ()
    named: float | None = None
    use: str = "-"


def main() -> None:
    """Run the searches that are asked for and print the table."""
    options = _options()
    with tempfile.TemporaryDirectory(prefix="asia-synthetic-") as scratch:
        out = options.out or Path(scratch)
        rows: dict[str, dict[str, Found]] = {}
        for name in options.systems:
            system = make_system(KNOWN[name], options.seed)
            directory = write_problem(system, out / "problems" / name, options.experiments)
            problem = load_problem(directory)
            rows[name] = {
                agent: _search(system, problem, agent, options.seed, out / "runs")
                for agent in options.agents
            }
    print(_table(rows, options.agents))
    if {"expert", "random"} <= set(options.agents):
        print(_reached(rows))
    if options.figure:
        _draw(rows, options.agents, options.figure)


def _options() -> argparse.Namespace:
    parser = option_parser(__doc__)
    parser.add_argument("--systems", type=words(KNOWN), default=list(KINDS), metavar="A,B")
    agents = ["expert", "random"]
    parser.add_argument("--agents", type=words(AGENTS), default=agents, metavar="A,B")
    parser.add_argument("--experiments", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the systems and of the searches")
    parser.add_argument("--out", type=Path, help="keep problems and runs here, and resume")
    parser.add_argument("--figure", type=Path, help="draw the curves here")
    return parser.parse_args()


def _search(system: System, problem: Problem, agent: str, seed: int, runs: Path) -> Found:
    """One search with the truth as a reference, unsealed; resumes what is in `runs`."""
    count = problem.budget.experiments
    problem = replace(problem, truth=(system.train.truth,))
    name = f"{problem.name}-{agent}-s{seed}-n{count}"
    ready = prepare(problem, agent, seed=seed, runs=runs, name=name)
    start = time.monotonic()

    def on_event(event: Event, view: SearchView) -> None:
        if isinstance(event, Evaluated):
            outcome = event.outcome
            value = f"V={outcome.value:.4f}" if isinstance(outcome, Score) else outcome.reason.value
            title = view.experiment(event.experiment).proposed.title
            line = f"{event.experiment}/{count} {event.status:<12} {value:<11}"
            print(f"{name}  {line}{event.seconds:6.1f} s  {title}", file=sys.stderr, flush=True)

    view = search(ready, make_agent(agent), on_event, lambda view: None)
    ratio, named, use = _errors_over_noise(system, problem, ready.directory, view)
    found = replace(_found(view, ratio), named=named, use=use)
    print(
        f"{name}  error over noise {_number(ratio)}, {use} {_number(named)}, "
        f"evaluations {found.seconds:.0f} s, "
        f"wall {time.monotonic() - start:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    return found


def _errors_over_noise(
    system: System, problem: Problem, directory: Path, view: SearchView
) -> tuple[float | None, float | None, str]:
    """Errors of the ensemble and of the model that the search names, and its name."""
    named = model_to_use(view)
    if named is None:
        return None, None, "-"
    record = unseal(directory).record
    both = (record.ensemble, tested_model(record, named.model))
    errors = [_error_over_noise(system, problem, one, record.lengths, directory) for one in both]
    return errors[0], errors[1], named.model


def _error_over_noise(
    system: System,
    problem: Problem,
    tested: TestedModel | Failure,
    lengths: Sequence[int],
    directory: Path,
) -> float | None:
    """A model on the test record against the truth there."""
    if isinstance(tested, Failure):
        return None
    ny = len(problem.outputs)
    store = Store(directory / "artifacts")
    (y_hat,) = store.get_arrays(tested.y_hat, [(n, ny) for n in lengths])
    truth = system.test.truth[problem.protocol.past :]
    error = np.sqrt(np.mean((truth - y_hat) ** 2, axis=0))
    return float(np.mean(error / system.noise_std))


def _found(view: SearchView, ratio: float | None) -> Found:
    references = {r.name: r.outcome.value for r in view.references if isinstance(r.outcome, Score)}
    best = view.best
    return Found(
        linear=references.get(LINEAR),
        floor=references.get(FLOOR),
        best=best.score.value if best and best.score else None,
        number=best.number if best else None,
        family=best.proposed.family if best else "none",
        ratio=ratio,
        failures=sum(e.failure is not None for e in view.finished),
        seconds=view.seconds,
        curve=_curve(view),
    )


def _curve(view: SearchView) -> tuple[float, ...]:
    values = [e.score.value if e.score else float("inf") for e in view.finished]
    return tuple(float(v) for v in np.minimum.accumulate(values))


def _reached(rows: dict[str, dict[str, Found]]) -> str:
    """How soon the expert is as good as random search at the end of its budget."""
    needed: list[float] = []
    for found in rows.values():
        target = found["random"].curve[-1]
        within = [k + 1 for k, v in enumerate(found["expert"].curve) if v <= target]
        needed.append(within[0] if within else float("inf"))
    budget = max(len(found["random"].curve) for found in rows.values())
    each = ", ".join(f"{n} {k:g}" for n, k in zip(rows, needed, strict=True))
    return (
        f"\nExperiments the expert needed for random's best of {budget}: median "
        f"{median(needed):g} ({each}; inf: never)"
    )


def _draw(rows: dict[str, dict[str, Found]], agents: Sequence[str], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for agent in agents:
        length = min(len(found[agent].curve) for found in rows.values())
        floors = [found[agent].floor or 1.0 for found in rows.values()]
        curves = np.array([found[agent].curve[:length] for found in rows.values()])
        curves = curves / np.array(floors)[:, None]
        low, middle, high = np.quantile(curves, [0.25, 0.5, 0.75], axis=0, method="nearest")
        steps = np.arange(1, length + 1)
        (line,) = axes.step(steps, middle, where="post", label=agent)
        axes.fill_between(steps, low, high, step="post", alpha=0.2, color=line.get_color())
    axes.set(xlabel="experiment", ylabel="best V so far over the noise floor", yscale="log")
    axes.legend()
    figure.savefig(path, dpi=150)


def _table(rows: dict[str, dict[str, Found]], agents: Sequence[str]) -> str:
    heads = ["system", "noise floor in V", "V linear model"]
    for agent in agents:
        heads += [f"V {agent}", "best at", "family", "failed"]
    heads += [f"error over noise, {agent}" for agent in agents]
    heads += [f"of the model to use, {agent}" for agent in agents]
    lines: list[list[str]] = []
    for name, found in rows.items():
        first = found[agents[0]]
        cells = [name, _number(first.floor), _number(first.linear)]
        for agent in agents:
            f = found[agent]
            at = "-" if f.number is None else f"#{f.number}"
            cells += [_number(f.best), at, f.family, str(f.failures)]
        cells += [_number(found[agent].ratio) for agent in agents]
        cells += [f"{_number(found[agent].named)} ({found[agent].use})" for agent in agents]
        lines.append(cells)
    lines.append(_medians(rows, agents))
    return table(heads, lines)


def _medians(rows: dict[str, dict[str, Found]], agents: Sequence[str]) -> list[str]:
    """Medians over the systems; a search without a scored model counts as infinite."""
    firsts = [found[agents[0]] for found in rows.values()]
    cells = ["**median**", _median([f.floor for f in firsts]), _median([f.linear for f in firsts])]
    for agent in agents:
        cells += [_median([found[agent].best for found in rows.values()]), "", "", ""]
    cells += [_median([found[agent].ratio for found in rows.values()]) for agent in agents]
    return [*cells, *(_median([found[agent].named for found in rows.values()]) for agent in agents)]


def _median(values: Sequence[float | None]) -> str:
    return f"**{median(float('inf') if v is None else v for v in values):.3g}**"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


if __name__ == "__main__":
    main()
