"""Whole searches with attacking candidates, submitted through each interface."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path

import anyio
import numpy as np
from mcp import Client

import asia
from asia.data.trajectory import Trajectory
from asia.interfaces.mcp import open_search
from asia.interfaces.mcp.server import make_server
from asia.interfaces.workspace.process import SearchRequest
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.redteam.attacks.source import HONEST, fill_in
from tests.redteam.problem import SmallProblem, small_problem
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.interfaces.mcp.conftest import Agent
from tests.unit.interfaces.workspace.desks import end_searches
from tests.unit.judge.executor.cluster import two_workers
from tests.unit.search.toy import Scripted


class Interface(StrEnum):
    """Way in which candidates are submitted."""

    LOCAL = "local"
    """By an agent in this process."""
    WORKSPACE = "workspace"
    """By `asia try` in a workspace."""
    MCP = "mcp"
    """By a client of the MCP server."""
    DASK = "dask"
    """By an agent in this process, whose folds are fitted by a Dask cluster."""


def search_with(
    candidates: Sequence[str],
    interface: Interface,
    folder: Path,
    problem: SmallProblem | None = None,
    *,
    guard: bool = True,
    isolation: Isolation | None = None,
) -> SearchView:
    """Run a search whose first candidate is the honest one of the suite, and the others are these.

    Args:
        candidates: sources as in the suite, with its names to fill in
        folder: empty folder for the problem and the run
        problem: small problem of contiguous folds; None for "simulation"
        guard: whether the problem has guard records
        isolation: level of the sandbox; None for the strongest, which alone other interfaces take
    """
    small = problem or small_problem("simulation")
    written = write_problem(folder / "small", small, len(candidates) + 1, guard=guard)
    runs = folder / "runs"
    sources = [filled(source, small, folder) for source in candidates]
    if isolation is None:
        _SUBMIT[interface](written, runs, sources)
    else:
        agent = Scripted(tuple(sources))
        ready = prepare(load_problem(written), agent.name, seed=0, runs=runs, isolation=isolation)
        search(ready, agent, lambda event, view: None, lambda view: None)
    (run,) = (path for path in runs.iterdir() if (path / "ledger.jsonl").exists())
    end_searches(run)
    return open_run(run).view


def filled(source: str, problem: SmallProblem, folder: Path) -> str:
    """As the suite submits it, with a folder as its only target."""
    return fill_in(source, repr({"MARK": "rt-interface", "FOLDER": str(folder)}), problem)


def write_problem(folder: Path, problem: SmallProblem, experiments: int, *, guard: bool) -> Path:
    """The small problem as files, with the suite's honest candidate as the baseline."""
    folder.mkdir()
    names = [signal.name for signal in problem.context.inputs]

    def write(kind: str, records: Sequence[Trajectory]) -> list[str]:
        files = [f"{kind}{number}.csv" for number in range(len(records))]
        for name, record in zip(files, records, strict=True):
            table = np.concatenate([record.u, record.y], axis=1)
            header = ",".join([*names, "level"])
            np.savetxt(folder / name, table, fmt="%.17g", delimiter=",", header=header, comments="")
        return files

    rule = problem.rule
    assert rule.folds.kind == "contiguous", rule.folds
    data: dict[str, object] = {"train": write("train", problem.records)}
    data |= {"guard": write("guard", problem.guard)} if guard else {}
    protocol: dict[str, object] = {
        "kind": rule.kind,
        "past_inputs": rule.past_inputs,
        "past_outputs": rule.past_outputs,
    }
    protocol |= {} if rule.horizon is None else {"horizon": rule.horizon}
    preprocess = {"detrend": True, "scale": True} if problem.standardised else {}
    budget = {"experiments": experiments, "fit_seconds": 60, "retests": 0}

    def table(name: str, values: Mapping[str, object]) -> str:
        lines = (f"{key} = {json.dumps(value)}\n" for key, value in values.items())
        return f"[{name}]\n{''.join(lines)}" if values else ""

    (folder / "baseline.py").write_text(filled(HONEST, problem, folder))
    (folder / "problem.toml").write_text(
        f'name = "small"\nsampling_time = 1.0\ninputs = {json.dumps(names)}\noutputs = ["level"]\n'
        + table("data", data)
        + table("preprocess", preprocess)
        + table("protocol", protocol)
        + f"folds = {{ count = {rule.folds.count} }}\n"
        + table("budget", budget)
    )
    return folder


def _locally(problem: Path, runs: Path, sources: Sequence[str]) -> None:
    asia.run(problem, agent=Scripted(tuple(sources)), runs=runs)


def _by_cluster(problem: Path, runs: Path, sources: Sequence[str]) -> None:
    folder = runs.parent / "cluster"
    folder.mkdir()
    with two_workers(folder) as cluster:
        cluster.connected(2).close()
        agent, executor = Scripted(tuple(sources)), f"dask:{cluster.file}"
        asia.run(problem, agent=agent, runs=runs, executor=executor)


def _by_workspace(problem: Path, runs: Path, sources: Sequence[str]) -> None:
    folder = runs.parent / "work"
    own = [] if "guard = " in (problem / "problem.toml").read_text() else ["--no-guard"]
    made = command_line("agent", "workspace", problem, folder, "--runs", runs, *own)
    assert made.code == 0, made.err
    for number, source in enumerate(sources):
        (folder / "candidate.py").write_text(source)
        done = command_line("try", "-m", f"a lower V, {number}", "--dir", folder)
        assert done.code in (0, 3), done.err


def _by_mcp(problem: Path, runs: Path, sources: Sequence[str]) -> None:
    request = SearchRequest(problem=str(problem), agent="mcp")

    async def submit() -> None:
        async with Client(make_server(open_search(request, runs, None))) as client:
            agent = Agent(client)
            for source in sources:
                await agent.judged(await agent.submit(source))

    anyio.run(submit)


_SUBMIT: dict[Interface, Callable[[Path, Path, Sequence[str]], None]] = {
    Interface.LOCAL: _locally,
    Interface.WORKSPACE: _by_workspace,
    Interface.MCP: _by_mcp,
    Interface.DASK: _by_cluster,
}
