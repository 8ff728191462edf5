"""Conformance suite for candidates."""

from collections.abc import Sequence

import numpy as np

from asia.candidate import Context, check_source, executed_source
from asia.data.segment import Segment
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import CandidateError
from asia.judge.evaluation.relations import suspicions
from asia.judge.evaluation.requests import simulate_held_out
from asia.judge.sandbox.availability import open_worker, probe
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.folds import whole
from asia.problem.physics import ParameterRange, Physics
from asia.problem.protocol import ProtocolRule

_LIMITS = Limits(300.0, 120.0, 4096)


def check_candidate(
    source: str,
    trajectories: Sequence[Trajectory] = (),
    context: Context | None = None,
    level: Isolation | None = None,
) -> None:
    """Fit a candidate and simulate the records it was fitted to, in isolated workers.

    Checked: the static checks pass; simulations have the right shape, are finite and vary; the
    model comes back from its bytes bitwise the same in a fresh worker, and so does a second fit;
    the metamorphic checks of `asia.judge.evaluation.relations.suspicions` find nothing: the model
    is causal,
    continuous, without memory, and independent of its neighbours in a request.

    Args:
        trajectories, context: training records and context; by default a leaking tank with its
            equation
        level: isolation level, the strongest here by default

    Raises:
        AssertionError: that says what fails
    """
    records = list(trajectories) or [tank()]
    try:
        _check(source, records, context or tank_context(), level or probe().level)
    except CandidateError as error:
        words = f"{error.reason.advice}: {error.detail}" if error.detail else error.reason.advice
        raise AssertionError(f"the candidate fails ({error.reason}): {words}") from error


def _check(source: str, records: Sequence[Trajectory], context: Context, level: Isolation) -> None:
    check_source(source)
    rule = ProtocolRule(
        kind="simulation" if context.horizon is None else "windows",
        past_inputs=context.n_past_u,
        past_outputs=context.n_past_y,
        horizon=context.horizon,
    )
    blocks = whole(records, rule)
    scale = np.concatenate([record.y for record in records]).std(axis=0)
    with open_worker(level, _LIMITS) as worker:
        y_hat = _fitted(worker, source, records, context, blocks)
        model = worker.dump()
    assert max(float(y.std(axis=0).max()) for y in y_hat) > 0, "no output moves"
    with open_worker(level, _LIMITS) as fresh:
        fresh.load(executed_source(source), model, context)
        again = simulate_held_out(fresh, blocks)
    assert _same(again, y_hat), "the model reloaded from its bytes simulates differently"
    with open_worker(level, _LIMITS) as fresh:
        fresh.load(executed_source(source), model, context)
        found = suspicions(fresh, blocks, y_hat, scale, rule.horizon)
    words = "; ".join(f"{one.kind}: {one.words}" for one in found)
    assert not found, f"it does not behave like a dynamical system: {words}"
    with open_worker(level, _LIMITS) as other:
        again = _fitted(other, source, records, context, blocks)
    assert _same(again, y_hat), "a second fit with the same seed gives another model"


def _fitted(
    worker: Worker,
    source: str,
    records: Sequence[Trajectory],
    context: Context,
    blocks: Sequence[Segment],
) -> tuple[Array, ...]:
    worker.fit(executed_source(source), records, context)
    return simulate_held_out(worker, blocks)


def _same(one: Sequence[Array], other: Sequence[Array]) -> bool:
    return all(a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True))


def tank() -> Trajectory:
    """A leaking tank with a pump, slightly noisy."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(0.5, 1.5, size=20), 10)
    x = np.ones(len(u))
    for k in range(len(u) - 1):
        x[k + 1] = x[k] + 0.1 * (-0.5 * np.sqrt(x[k]) + 0.5 * u[k])
    return Trajectory(u, x + 0.002 * rng.normal(size=len(x)), 0.1, "tank")


def tank_context() -> Context:
    """The tank's problem, with its equation."""
    physics = Physics(
        states=("level",),
        dynamics={"level": "-k1*sqrt(level) + k2*flow"},
        parameters={"k1": ParameterRange(0.05, 5.0), "k2": ParameterRange(0.05, 5.0)},
    )
    inputs, outputs = (Signal("flow"),), (Signal("level"),)
    return Context(inputs, outputs, 0.1, n_past_u=5, n_past_y=5, physics=physics, seed=1)
