"""Plant of a control problem: its closed loop, a trial of it, and identification from its
records."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.fold_fits import derive_seed, search_context
from asia.judge.evaluation.references import LINEAR
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.programs import program_store
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.closed_loop import Ask, BeginPlant, ClosedLoop
from asia.judge.sandbox.worker.worker import Worker
from asia.models import simulator
from asia.problem.control import Control
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem

Opener: TypeAlias = Callable[[str], AbstractContextManager[Worker]]
"""Opens a worker for a source."""

_PLANT = """from asia.models import simulator


def fit(trajectories, context):
    model, u = simulator.stepped(context), trajectories[0].u[None]
    model.simulate(u[:, :0], u[:, :0], u)
    return model
"""
_GREYBOX = '''"""Equations of the problem, fitted."""

from asia.models import greybox
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = greybox.build(greybox.Config(), context)
    return greybox.train(model, trajectories, context, LevenbergMarquardt(30, starts=2))
'''
# Shortest part of the records that a model is identified from by itself.
_SHORTEST = 100


def closed_loop(problem: Problem, opener: Opener) -> ClosedLoop | None:
    """Closed loop of a control problem; None for other problems.

    Args:
        opener: opens the worker that runs the plant of a user's own; one that comes with ASIA runs
            in this process.
    """
    control = problem.control
    if control is None:
        return None
    table, base = control.table, control.base
    names = [s.name for s in base.outputs]
    return ClosedLoop(
        plant=partial(_opened, control, opener),
        actuators=control.actuators,
        sampling_time=problem.sampling_time,
        outputs=len(names),
        controlled=tuple(names.index(s.name) for s in control.controlled),
        disturbances=len(table.disturbances),
        noisy=tuple(k for k, name in enumerate(names) if name in table.noise),
    )


@contextmanager
def _opened(control: Control, opener: Opener) -> Generator[BeginPlant]:
    base, plant = control.base, control.plant
    disturbances = (Signal(name) for name in control.table.disturbances)
    context = Context(
        (*base.inputs, *disturbances), base.outputs, base.sampling_time, 0, 0, plant=plant
    )
    nu = len(context.inputs) + len(plant.parameters) + len(plant.initial)
    if plant.is_built_in:
        yield lambda: nullcontext(_in_process(context))
        return
    # Two samples at the start, whose failure has a message.
    ranges = (*control.table.disturbances.values(), *plant.parameters.values(),
              *plant.initial.values())  # fmt: skip
    first = [*(a.start for a in control.actuators), *(0.5 * (r.min + r.max) for r in ranges)]
    trial = Trajectory(np.tile(first, (2, 1)), np.zeros((2, len(base.outputs))), 1.0, "trial")
    with opener(_PLANT) as worker:
        try:
            worker.fit(_PLANT, (trial,), context)
        except CandidateError as error:
            raise _failure(control, error) from None

        @contextmanager
        def case() -> Generator[Ask]:
            with worker.stream(nu, len(base.outputs)) as ask:
                yield partial(_asked, ask)

        yield case


def _asked(ask: Ask, sample: Array) -> Array:
    try:
        return ask(sample)
    except (CandidateError, ArithmeticError, ValueError) as error:
        # An honest plant fails where a loop diverges. That it runs at all was tried before.
        if isinstance(error, CandidateError) and error.reason is Reason.SIMULATE_TIMEOUT:
            raise
        raise CandidateError(Reason.NOT_FINITE, "the plant failed in the closed loop") from None


def _in_process(context: Context) -> Ask:
    model, state = simulator.stepped(context), None

    def ask(sample: Array) -> Array:
        nonlocal state
        state, y = model.step(state, sample[None])
        return y[0]

    return partial(_asked, ask)


def _failure(control: Control, error: CandidateError) -> UserError:
    last = error.detail.strip().rpartition("\n")[2].rpartition("SimulatorError: ")[2]
    return UserError(f"[plant] {control.plant.label} failed: {last or error.reason.advice}")


def control_lines(problem: Problem, isolation: Isolation) -> list[str]:
    """Try the plant of a control problem in the sandbox, and describe its scenarios.

    Raises:
        UserError: for a plant that fails
    """
    control = problem.control
    assert control is not None
    cost = _cost_of_held_inputs(problem, isolation)
    table = control.table.scenarios
    return [
        f"plant: {control.plant.label}, {len(control.plant.parameters)} parameters drawn for each "
        "scenario",
        f"scenarios: {table.train} of {table.samples} samples in {table.folds} folds, {table.test} "
        f"sealed; V: {find_metric(problem.protocol.metric).label} in tolerances",
        "tolerances: "
        + ", ".join(
            f"{s.name} {tolerance:g} {s.unit}".rstrip()
            for s, tolerance in zip(control.responses, control.tolerance, strict=True)
        ),
        f"inputs held at their start cost {cost:.3g} in scenario {problem.train[0].name}",
    ]


def _cost_of_held_inputs(problem: Problem, isolation: Isolation) -> float:
    """Cost of the first scenario with the inputs held. Raises UserError for a plant that fails."""
    control, record = problem.control, problem.train[0]
    assert control is not None
    loop = closed_loop(problem, partial(_opened_worker, problem, isolation))
    assert loop is not None
    held = np.array([a.start for a in loop.actuators])
    try:
        with loop.plant() as plant:
            found = loop.simulate(lambda sample: held, plant, record.u)
    except CandidateError as error:
        raise _failure(control, error) from None
    if not np.isfinite(found).all():
        raise UserError(
            f"[plant] {control.plant.label} is not finite with its inputs held at their start "
            f"at sample {int(np.argmax(~np.isfinite(found).all(axis=1))) + 1}"
        )
    metric = find_metric(problem.protocol.metric)
    return metric.shortfall(record.y, found, np.array(control.tolerance))


def _opened_worker(
    problem: Problem, isolation: Isolation, source: str
) -> AbstractContextManager[Worker]:
    del source
    seconds = problem.budget.fit_seconds
    return open_worker(isolation, Limits(seconds, seconds, problem.budget.memory_mb))


def prepare_control(problem: Problem, isolation: Isolation) -> Problem:
    """Try the plant with its inputs held, and identify models from its records, in the sandbox.

    Returns:
        The problem with the models: of all records, and of parts of them where these are long.

    Raises:
        UserError: for a plant that fails, or records that no model can be identified from
    """
    control = problem.control
    if control is None:
        return problem
    _cost_of_held_inputs(problem, isolation)
    base = control.base
    source = LINEAR if base.physics is None else _GREYBOX
    context = search_context(base, derive_seed(0, "identification"))
    models: list[bytes] = []
    for records in _parts(base.train):
        try:
            with _opened_worker(problem, isolation, source) as worker:
                worker.fit(source, records, context, programs=program_store())
                models.append(worker.dump())
        except CandidateError as error:
            if not models:
                raise UserError(
                    f"no model of the plant could be identified from its records: {error}"
                ) from None
    return replace(problem, control=replace(control, models=tuple(dict.fromkeys(models))))


def _parts(records: tuple[Trajectory, ...]) -> list[tuple[Trajectory, ...]]:
    """All records, then their first and second halves."""
    if min(map(len, records)) < 2 * _SHORTEST:
        return [records]
    halves = [len(r) // 2 for r in records]
    first = tuple(r.alone(0, n) for r, n in zip(records, halves, strict=True))
    second = tuple(r.alone(n, len(r)) for r, n in zip(records, halves, strict=True))
    return [records, first, second]
