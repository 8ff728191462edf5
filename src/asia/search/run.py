"""Open or resume a run directory and search."""

from __future__ import annotations

import hashlib
import math
import platform
import re
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Final

from asia._plugins import parts, version_of
from asia.agents.registry import AGENT_ROWS, agent_row, can_read_records
from asia.agents.view import Agent
from asia.candidate import check_source, installed_libraries
from asia.errors import CandidateError, SandboxError, UserError
from asia.judge.evaluation.control import closed_loop, prepare_control
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.fold_fits import derive_seed, search_context
from asia.judge.evaluation.plant_check import check_plant
from asia.judge.evaluation.references import first_source
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import Executor, LocalExecutor, SequentialExecutor, remote_executor_of
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.layers.environment import shown_in
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation, Probe
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain, write_whole
from asia.ledger.events import RESUMABLE, Extended, Resumed, Started
from asia.ledger.folder import check_run_folder
from asia.ledger.looks import copy_words, look_by_copy
from asia.ledger.run import ERROR, keep_error
from asia.ledger.verification import check_lock
from asia.ledger.view import SearchView
from asia.presentation.exports import write_exports
from asia.problem.folds import Fold, fold_names, make_folds
from asia.problem.held_back import GUARD_SHARE
from asia.problem.load import with_models
from asia.problem.lock import lock_differences, lock_text, protocol_digest
from asia.problem.problem import Problem, kept_places, record_places
from asia.problem.seal import guard_digest, seal
from asia.search.decision import RETEST_LIMIT
from asia.search.loop import Loop, OnEvent
from asia.search.pending import check_parallel, check_steps_ahead
from asia.search.steering import RunningLosses

# Environment that outcomes and prompts depend on: Python, packages, model library.


def environment(agent: str) -> dict[str, str]:
    """Python, platform, versions of packages and plugins, and the digest of the model
    library. Raises UserError as `asia._plugins.parts`."""
    names = [*installed_libraries(), "cloudpickle", "asia-sysid", *agent_row(agent).packages]
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{part.package: part.version for part in parts()},
        **{name: version_of(name) for name in names},
        "asia.models": library_digest(),
    }


@cache
def library_digest() -> str:
    """12 hexadecimal digits of the sources of `asia.models`."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1] / "models"
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def environment_changes(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, ...]:
    """Describe each difference between the recorded and the present environment."""
    absent = {"asia.models": "not recorded"}
    return tuple(
        f"{name} {here.get(name, 'missing')} here, "
        f"{there.get(name, absent.get(name, 'missing'))} then"
        for name in sorted({**there, **here})
        if here.get(name) != there.get(name)
    )


# Check that hidden data lie outside every folder that candidates and agents can read.


def check_run_is_hidden(problem: Problem, directory: Path, level: Isolation) -> None:
    """Raises UserError when the run directory, a record or the key of the test lies in a folder
    that every worker can read. A level that confines nothing hides nothing, and nothing is checked
    there."""
    if not LEVELS[level].confined:
        return
    for path in (directory, *record_places(problem), *kept_places(problem)):
        check_hidden_from_workers(path)


def check_hidden_from_workers(path: Path) -> None:
    """Raises UserError when `path` lies in a folder that every worker can read."""
    folder = shown_in(path)
    if folder is not None:
        raise UserError(
            f"{path} lies in {folder}, which every candidate can read, because it holds the "
            "interpreter, its libraries or the package of a part: keep runs, data and keys "
            "elsewhere"
        )


def check_hidden_from_agent(shown: Iterable[Path], problem: Problem) -> None:
    """Raises UserError when a folder shown to an agent holds the test data or their key."""
    hidden = [path.resolve() for path in kept_places(problem)]
    for path in shown:
        real = path.resolve()
        for place in hidden:
            if real == place or real in place.parents or place in real.parents:
                raise UserError(
                    f"{path} would show the agent {place}, which contains test data or "
                    "their key: give a smaller folder"
                )


def guard_share(agent: str, wanted: bool | None) -> float | None:
    """Return the share of the training records to hold back as guard records; None for none.

    Args:
        agent: name of the agent.
        wanted: choice of the user; None to hold some back where the agent can read the rest.
    """
    held = can_read_records(agent) if wanted is None else wanted
    return GUARD_SHARE if held else None


LOCK = "problem.lock.toml"


@dataclass(frozen=True)
class Prepared:
    """A run directory ready to be searched: nothing was written yet."""

    problem: Problem
    directory: Path
    """Run directory, which may not exist yet."""
    lock: str
    """Text of the lock file: the problem resolved, with digests of its data."""
    started: Started
    """The first line of the ledger, as it would be written now."""
    resumes: bool
    """True if the run exists already."""


RUN_NAME: Final = re.compile(r"(?!\d+$)\w[\w.+-]*")
RUN_NAME_RULE: Final = (
    "expected letters, digits and . _ + - that begin with a letter or digit and are not a number "
    "alone"
)


def run_name(problem: Problem, agent: str, seed: int) -> str:
    """Return the name of a run that the user does not name."""
    name = f"{problem.name}-{agent}-s{seed}"
    name += "" if problem.protocol.early_stopping == "inner" else "-validation"
    return name + ("" if problem.protocol.residuals == "train" else "-residuals")


def prepare(
    problem: Problem,
    agent_name: str,
    *,
    seed: int,
    runs: Path,
    name: str | None = None,
    isolation: Isolation | None = None,
    isolation_strict: bool = False,
    agent_settings: Mapping[str, str] | None = None,
    parallel: int = 1,
) -> Prepared:
    """Check everything a search needs and compare it with an existing run. Writes nothing.

    Args:
        runs: folder of run directories.
        isolation: level of candidates; None for the strongest that is available.
        isolation_strict: true to fit the folds of a candidate sequentially.
        agent_settings: settings of the agent's proposals besides its name.
        parallel: number of concurrent experiments.

    Raises:
        UserError: the folds cannot be made, the test does not fit, the run exists with other
            settings, or several experiments are requested with sequential folds.
    """
    rule, budget = problem.protocol, problem.budget
    if problem.control is not None and not agent_row(agent_name).designs_controllers:
        known = ", ".join(row.name for row in AGENT_ROWS if row.designs_controllers)
        raise UserError(
            f"agent {agent_name} proposes models, and '{problem.name}' asks for a controller: use "
            f"{known} or an agent of your own"
        )
    check_parallel(parallel, strict=isolation_strict)
    check_baseline(problem)
    # The file's schema checks a budget that was read; this one may come from anywhere.
    if budget.experiments < 1:
        raise UserError(f"a budget of {budget.experiments} experiments: at least 1 is needed")
    if budget.hours is not None and not budget.hours > 0:
        raise UserError(f"a budget of {budget.hours:g} hours: more than 0 are needed")
    folds = make_folds(problem.train, rule)
    sealed = replace(seal(problem), guard=guard_digest(problem))
    directory = runs / (name or run_name(problem, agent_name, seed))
    check_run_folder(directory)
    found = _probed(isolation)
    check_run_is_hidden(problem, directory, found.level)
    resumes = (directory / "ledger.jsonl").is_file() and (directory / LOCK).is_file()
    if not resumes:
        check_plant(problem, found.level)
        problem = prepare_control(problem, found.level)
    else:
        problem = with_models(problem, directory)
        # The budget may grow. A run from before there were retests goes on by its ledger's rule.
        different = [
            one
            for one in lock_differences(problem, sealed, directory / LOCK)
            if one.key not in ("budget.experiments", "budget.hours")
            and not (one.key == "budget.retests" and one.before is None)
        ]
        if different:
            words = [str(one) for one in different[:3]]
            if len(different) > 3:
                words.append(f"{len(different) - 3} more")
            raise UserError(
                f"{directory} was started with other settings ({'; '.join(words)}); only "
                "the number of experiments and the hours can grow: choose another --name"
            )
    lock = lock_text(problem, sealed)
    started = Started(
        run=directory.name,
        problem=problem.name,
        agent=agent_name,
        seed=seed,
        experiments=budget.experiments,
        hours=budget.hours,
        outputs=tuple(s.name for s in problem.outputs),
        lock_digest=hashlib.sha256(lock.encode()).hexdigest(),
        protocol_digest=protocol_digest(problem),
        test_digest=sealed.sha256,
        isolation=found.level.value,
        isolation_notes=found.notes,
        environment=environment(agent_name),
        early_stopping=rule.early_stopping,
        residuals=rule.residuals,
        agent_settings=dict(agent_settings or {}),
        guard_digest=sealed.guard,
        layers=tuple(layer.value for layer in found.layers),
        salt=secrets.token_hex(16),
        isolation_strict=isolation_strict,
        folds=fold_names(folds, rule),
        retests=budget.retests,
        parallel=parallel,
        gate=problem.control is None and can_read_records(agent_name),
        retest_limit=RETEST_LIMIT,
        by_folds=problem.control is None,
    )
    return Prepared(problem, directory, lock, started, resumes)


def search(
    prepared: Prepared,
    agent: Agent,
    on_event: OnEvent,
    on_start: Callable[[SearchView], None],
    executor: Executor | None = None,
) -> SearchView:
    """Run or resume to the end of the budget; the finished view.

    Unfinished runs resume, finished ones return at once, a larger budget extends. Raises UserError
    when the run is in use, belongs to another agent or seed, or was unsealed.
    """
    directory, problem = prepared.directory, prepared.problem
    check_steps_ahead(prepared.started.parallel, agent)
    with Chain(directory / "ledger.jsonl") as chain:
        if not chain.lines:
            for model in problem.control.models if problem.control else ():
                Store(directory / "artifacts").put(model)
            write_whole(directory / LOCK, prepared.lock.encode())
            chain.append(prepared.started)
        view = chain.view
        check_lock(directory, view.started)
        check_same_search(view, prepared.started)
        limits = prepared.started.experiments, prepared.started.hours
        goes_on = not view.complete or limits != (view.budget, view.hours)
        if goes_on and (copy := look_by_copy(directory, view)) is not None:
            raise UserError(
                f"{copy_words(view.started.run, copy)}, which ended the search: choose another "
                "--name"
            )
        level = Isolation(prepared.started.isolation)
        evaluator = make_evaluator(problem, view, executor, isolation=level, controllers=True)
        evaluator.workers.on_loss = RunningLosses(directory)
        loop = Loop(
            problem=problem,
            baseline=first_source(problem),
            agent=agent,
            evaluator=evaluator,
            chain=chain,
            store=Store(directory / "artifacts"),
            directory=directory,
            on_event=on_event,
        )
        loop.store.tidy()
        # A search that was killed behind its last event has not written them.
        write_exports(directory, view)
        on_start(view)
        if limits != (view.budget, view.hours):
            loop.record(Extended(*limits))
        stopped = loop.view.stopped
        if stopped is not None and stopped.reason in RESUMABLE and view.unsealing is None:
            loop.record(Resumed())
        # A standby worker that starts during a fit could receive information through its timing.
        sequential = view.started.isolation_strict or remote_executor_of(executor) is not None
        ready = (
            nullcontext() if sequential else evaluator.workers.ready_workers(view.started.parallel)
        )
        (directory / ERROR).unlink(missing_ok=True)
        try:
            with ready:
                return loop.run()
        except Exception as error:
            path = keep_error(directory, error)
            error.add_note(f"the traceback is in {path}; the same command resumes the search")
            raise


def level_here(asked: Isolation | None = None) -> Isolation:
    """Return the level for candidates of an existing run: the strongest of this machine, or
    `asked`. Raises UserError where this machine does not have it."""
    return _probed(asked).level


def _probed(asked: Isolation | None) -> Probe:
    try:
        return probe(asked)
    except SandboxError as error:
        raise UserError(f"{error}; omit --isolation to use the strongest available level") from None


def make_evaluator(
    problem: Problem,
    view: SearchView,
    executor: Executor | None = None,
    folds: Sequence[Fold] | None = None,
    without: Collection[SuspicionKind] = (),
    isolation: Isolation | None = None,
    *,
    controllers: bool = False,
) -> Evaluator:
    """Make the evaluator of a run.

    Args:
        controllers: whether the caller can use a run whose candidates are controllers.
        folds: folds in place of those of the problem.
        without: as in `EvaluatorOptions`.
        isolation: level of the candidates; None for the strongest of this machine. The level that
            the ledger names has no effect, because the run may come from somebody else.

    Raises:
        UserError: this machine does not have the level, or the candidates are controllers.
    """
    rule = problem.protocol
    if problem.control is not None and not controllers:
        raise UserError(
            f"run '{view.started.run}' searched for a controller, and this needs a model: use a "
            "run that identified the plant"
        )
    runs_on = executor or LocalExecutor()
    if problem.control is not None and remote_executor_of(executor) is not None:
        raise UserError("controllers are simulated on this machine: use --executor local")
    context = search_context(problem, derive_seed(view.started.seed, "search"))
    chosen = make_folds(problem.train, rule) if folds is None else tuple(folds)
    workers = WorkerRunner(
        level_here(isolation),
        problem.budget,
        SequentialExecutor(runs_on) if view.started.isolation_strict else runs_on,
        standby=len(chosen),
    )
    workers.closed_loop = closed_loop(problem, partial(workers.open_for, fitting=True, plant=True))
    data = EvaluationData(chosen, problem.train, context, rule)
    options = EvaluatorOptions(view.started.salt, without, view.started.lock_digest)
    return Evaluator(data, workers, options)


def check_baseline(problem: Problem) -> None:
    """Raises UserError when the problem's baseline.py is not a candidate."""
    if problem.baseline is None:
        return
    try:
        check_source(problem.baseline)
    except CandidateError as error:
        raise UserError(f"baseline.py of problem '{problem.name}': {error.reason.advice}") from None


def check_same_search(view: SearchView, wanted: Started) -> None:
    """Raises UserError unless `wanted` asks for the same search, or for more of it."""
    start = view.started
    for what, was_used in (
        ("lessons", start.lessons is not None),
        ("--device gpu", start.device == "gpu"),
    ):
        if was_used:
            raise UserError(
                f"run '{start.run}' was started with {what}, which this version does not support: "
                "choose another --name"
            )
    settings = start.agent_settings, wanted.agent_settings
    for what, there, now in (
        ("agent", start.agent, wanted.agent),
        ("seed", start.seed, wanted.seed),
        ("isolation", start.isolation_words, wanted.isolation_words),
        ("--parallel", start.parallel, wanted.parallel),
        (
            "the gate of the guard records",
            *("on" if on else "off" for on in (start.gate, wanted.gate)),
        ),
        *(
            (f"an agent with {name}", *(s.get(name, "its default") for s in settings))
            for name in dict.fromkeys([*settings[0], *settings[1]])
        ),
    ):
        if there != now:
            raise UserError(
                f"run '{start.run}' has {what} {there}, not {now}: choose another --name"
            )
    lost = [layer for layer in start.layers if layer not in wanted.layers]
    if lost:
        raise UserError(
            f"run '{start.run}' started with a layer of isolation that is not available "
            f"({', '.join(lost)}): continue it where it started, or choose another --name"
        )
    grows = False
    for what, there, now in (
        ("experiments", view.budget, wanted.experiments),
        ("hours", view.hours, wanted.hours),
    ):
        before, after = (math.inf if limit is None else limit for limit in (there, now))
        if after < before:
            has = f"{before:g} {what}" if math.isfinite(before) else f"no limit of {what}"
            raise UserError(
                f"run '{start.run}' has {has}, and a budget can only grow: ask for at least that, "
                "or choose another --name"
            )
        grows = grows or after > before
    if view.unsealing and grows:
        raise UserError(
            f"run '{start.run}' was unsealed, which ended the search: choose another --name"
        )
