"""The library's front door: what the command line does, in a function."""

from collections.abc import Sequence
from pathlib import Path

from asia.agents.registry import NamedAgent, choose_agent
from asia.agents.view import Agent, settings_of
from asia.judge.executors import Executor, make_executor
from asia.ledger.run import Run, open_run
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.problem.protocol import EarlyStopping
from asia.search.run import guard_share, prepare, search
from asia.search.settings import SearchSettings
from asia.search.sinks import OpenSink, open_sinks


def run(
    problem: Problem | str | Path,
    *,
    agent: Agent | str = "expert",
    experiments: int | None = None,
    seed: int = 0,
    runs: Path | str = "runs",
    name: str | None = None,
    early_stopping: EarlyStopping | None = None,
    executor: Executor | str = "local",
    sinks: Sequence[str | OpenSink] = (),
    parallel: int = 1,
    guard: bool | None = None,
) -> Run:
    """Search for a model, and return the finished run with its view and artifacts.

    The same call again resumes; more `experiments` extends.

    Args:
        problem: a loaded problem, a built-in name or a path
        agent: an agent, or its name as in `asia run --agent`: `module:Class` for one of your own
        early_stopping: in place of the problem's own setting
        executor: one of `executor_names()`, or an object, that runs the evaluations
        sinks: receivers of events: an installed one by name, `module:Name`, or a function that
            opens one, see `asia.search.sinks.Sink`
        parallel: experiments in flight
        guard: hold back 15 % of the training records of a problem that is not loaded yet, to
            confirm new bests; None to do so where the agent writes candidates

    Raises:
        UserError: for anything the caller can correct
    """
    chosen = (
        choose_agent(agent) if isinstance(agent, str) else NamedAgent(agent, settings_of(agent))
    )
    share = guard_share(chosen.agent.name, guard)
    loaded = problem if isinstance(problem, Problem) else load_problem(problem, share)
    settings = SearchSettings(experiments=experiments, early_stopping=early_stopping)
    loaded = settings.applied(loaded)
    ready = prepare(
        loaded,
        chosen.agent.name,
        seed=seed,
        runs=Path(runs),
        name=name,
        agent_settings=chosen.settings,
        parallel=parallel,
    )
    runs_on = make_executor(executor) if isinstance(executor, str) else executor
    with open_sinks(ready.directory, sinks) as opened:
        on_event = opened.after_event(lambda event, view: None)
        on_start = opened.after_start(lambda view: None)
        search(ready, chosen.agent, on_event, on_start, runs_on)
    return open_run(ready.directory)
