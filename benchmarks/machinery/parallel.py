"""By how much several experiments in flight shorten a search, in one run, over one worker.

    python benchmarks/machinery/parallel.py --experiments 30 --seconds 2
    python benchmarks/machinery/parallel.py --problem cascaded_tanks --agent random --in-flight 2

The one worker, and its search, have one core.

1. Candidates that compute for about `--seconds` a fold: one worker; two, with two experiments in
   flight; two workers of a Dask cluster with one core each (extra `dask`).
2. Candidates that sleep: one worker; eight, with sixteen experiments in flight.

Searches of one kind have the same candidates, so V must be the same in all of them. The last line
of each kind says so. With `--problem`, an agent searches a built-in problem instead, with one
worker, two, and two of Dask, and with `--in-flight` experiments; the best V of each search is
printed beside what a better one needs.
The candidates of `random` do not depend on results, so its V must be the same. Valid only on a
machine without other load; the load is printed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from asia.agents import Agent, AgentView, Proposal, make_agent
from asia.errors import UserError
from asia.judge.executors import Executor, make_executor
from asia.judge.executors.dask import DaskExecutor
from asia.ledger.view import SearchView
from asia.presentation.experiments import threshold_text
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.run import prepare, search

CANDIDATE = """
import time

import numpy as np

GAIN = {gain!r}


class Model:
    def simulate(self, past_u, past_y, u):
        return GAIN * u[:, :, :1]


def fit(trajectories, context):
    {spend}
    return Model()
"""
COMPUTE = (
    "end = time.process_time() + {seconds}\n    while time.process_time() < end:\n        pass"
)
SLEEP = "time.sleep({seconds})"
# Otherwise the scheduler and two workers take 8 % of a core for themselves.
QUIET = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "10s",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "500ms",
}


@dataclass(frozen=True)
class Listed:
    """Proposes candidates whose fits take from half to one and a half of `seconds`."""

    spend: str
    seconds: float
    name: str = "listed"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal:
        number = len(view.proposed)
        share = np.random.default_rng(number).uniform(0.5, 1.5)
        spend = self.spend.format(seconds=round(self.seconds * share, 3))
        source = CANDIDATE.format(gain=0.5 + 0.01 * number, spend=spend)
        return Proposal(source, "made up", f"number {number}", "made up", "made up")


def made_problem(folder: Path, experiments: int) -> Problem:
    rng = np.random.default_rng(0)
    u = rng.normal(size=200)
    table = np.stack([u, 0.8 * u + 0.1 * rng.normal(size=200)], axis=1)
    folder.mkdir()
    np.savetxt(folder / "train.csv", table, delimiter=",", header="u,y", comments="")
    (folder / "baseline.py").write_text(CANDIDATE.format(gain=0.1, spend="pass"))
    (folder / "problem.toml").write_text(
        'name = "made_up"\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\n'
    )
    problem = load_problem(folder)
    budget = replace(problem.budget, experiments=experiments, retests=0, patience=10**6)
    return replace(problem, budget=budget)


def timed(
    problem: Problem, agent: Agent, runs: Path, parallel: int, executor: Executor
) -> tuple[float, SearchView]:
    """Seconds from the first proposal to the last result, and the search."""
    times: list[float] = []
    ready = prepare(problem, agent.name, seed=0, runs=runs, parallel=parallel)

    def told(event: object, view: SearchView) -> None:
        if getattr(event, "event", "") in ("proposed", "evaluated"):
            times.append(time.monotonic())

    view = search(ready, agent, told, lambda view: None, executor)
    return times[-1] - times[0], view


def values(view: SearchView) -> list[float | None]:
    return [e.score.value if e.score else None for e in view.finished]


@contextmanager
def dask_workers(folder: Path, count: int) -> Iterator[Executor]:
    """A scheduler and workers of one core each on this machine."""
    file, dask = folder / "scheduler.json", Path(sys.executable).with_name("dask")
    common = ("--no-dashboard", "--scheduler-file", str(file))
    commands = [[str(dask), "scheduler", "--port", "0", "--host", "127.0.0.1", *common]]
    commands += [[str(dask), "worker", "--nthreads", "1", "--no-nanny", *common]] * count
    with (folder / "dask.log").open("wb") as log:
        started = [
            subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **QUIET})
            for command in commands
        ]
    try:
        executor = _connected(f"dask:{file}")
        yield executor
        executor.close()
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def _connected(name: str) -> DaskExecutor:
    end = time.monotonic() + 60.0
    while True:
        try:
            executor = make_executor(name)
            assert isinstance(executor, DaskExecutor)
            time.sleep(3.0)
            return executor
        except UserError:
            if time.monotonic() > end:
                raise
            time.sleep(0.5)


@contextmanager
def one_core() -> Iterator[None]:
    """Limit processes started in here to one core: the search, its worker and standby workers."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def compare(root: Path, kind: str, spend: str, seconds: float, experiments: int) -> None:
    problem = made_problem(root / kind, experiments)
    agent = Listed(spend, seconds)
    many = (2, 2) if kind == "compute" else (8, 16)
    with one_core():
        alone, first = timed(problem, agent, root / f"{kind}-1", 1, make_executor("local:1"))
    print(f"{kind}: one worker                                  {alone:8.1f} s")
    found = [first]
    workers, in_flight = many
    wall, view = timed(
        problem, agent, root / f"{kind}-{workers}", in_flight, make_executor(f"local:{workers}")
    )
    found.append(view)
    print(
        f"{kind}: {workers} workers, {in_flight} in flight                      {wall:8.1f} s, "
        f"speed-up {alone / wall:.2f}"
    )
    if kind == "compute" and importlib.util.find_spec("distributed") is not None:
        with dask_workers(root, 2) as executor:
            wall, view = timed(problem, agent, root / "dask", 2, executor)
        found.append(view)
        print(
            f"{kind}: 2 Dask workers, 2 in flight                 {wall:8.1f} s, "
            f"speed-up {alone / wall:.2f}"
        )
    same = all(values(one) == values(first) for one in found)
    print(f"{kind}: V is {'the same' if same else 'NOT the same'} in all searches")


def compare_searches(root: Path, name: str, agent: str, experiments: int, in_flight: int) -> None:
    problem = load_problem(name)
    problem = replace(problem, budget=replace(problem.budget, experiments=experiments))
    walls: list[float] = []
    found: list[SearchView] = []

    def run(what: str, parallel: int, executor: Executor) -> None:
        wall, view = timed(problem, make_agent(agent), root / what, parallel, executor)
        walls.append(wall)
        found.append(view)
        best = view.best.score if view.best else None
        print(
            f"{name}, {agent}, {what}: {wall:.0f} s, speed-up {walls[0] / wall:.2f}, "
            f"{len(view.finished)} experiments, V {best.value if best else 'none'}, "
            f"needed: {threshold_text(view)}",
            flush=True,
        )

    with one_core():
        run("one worker", 1, make_executor("local:1"))
    run("two workers", in_flight, make_executor("local:2"))
    if importlib.util.find_spec("distributed") is not None:
        with dask_workers(root, 2) as executor:
            run("two Dask workers", in_flight, executor)
    same = all(values(one) == values(found[0]) for one in found)
    print(f"{name}, {agent}: V is {'the same' if same else 'NOT the same'} in all experiments")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=2.0, help="of a fold's fit, about")
    parser.add_argument("--problem", help="a built-in problem, for searches by an agent")
    parser.add_argument("--agent", default="random")
    parser.add_argument("--in-flight", type=int, default=2, help="with --problem; default 2")
    options = parser.parse_args()
    print(f"load before {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as folder:
        if options.problem:
            compare_searches(
                Path(folder), options.problem, options.agent, options.experiments, options.in_flight
            )
            return
        for kind, spend in (("compute", COMPUTE), ("sleep", SLEEP)):
            compare(Path(folder), kind, spend, options.seconds, options.experiments)
    print(f"load after {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
