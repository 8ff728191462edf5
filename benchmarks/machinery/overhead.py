"""Cost of an experiment beyond the candidate's own work, per fold.

python benchmarks/machinery/overhead.py [--repeats 5]

Overhead = wall time of one fold in the evaluator (start of the worker, fit, the model's bytes, the
simulations, scoring, end of the worker) - seconds inside the candidate's `fit`, compilation
included, - seconds inside its `simulate`; both measured by the candidate itself, so that all that
passes between the processes counts as overhead. Importing the candidate's libraries counts as
overhead too, and is also shown alone. A would-be winner is loaded once more from its bytes: that
check is shown alone. Folds run one after the other, with workers that each are started for their
fold and with workers started ahead, as in a search. Exits with 1 when a median is over its limit.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from statistics import median
from types import ModuleType
from typing import TypeVar, cast

import numpy as np

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import Score
from asia.problem import Budget
from asia.problem.folds import Fold, make_folds, whole
from asia.problem.protocol import ProtocolRule

T = TypeVar("T")

SAMPLES = 1000
LIMITS = {"numpy": 0.3, "jax": 1.0}

# Both answer with the seconds their simulate took as the first output, and log the seconds of
# their imports and of their fit as the first and the second row of the training curve.
NUMPY = """
import time
BEGIN = time.perf_counter()
import numpy as np
IMPORTED = time.perf_counter() - BEGIN


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        begin = time.perf_counter()
        known = past_y.shape[1]
        x = np.concatenate([past_u, u], axis=1)
        y = np.concatenate([past_y, np.zeros((*u.shape[:2], past_y.shape[2]))], axis=1)
        for k in range(known, y.shape[1]):
            lags = [y[:, k - 1], y[:, k - 2], x[:, k], x[:, k - 1], x[:, k - 2]]
            y[:, k] = np.concatenate(lags, axis=1) @ self.weights
        y[0, known, 0] = time.perf_counter() - begin
        return y[:, known:]


def fit(trajectories, context):
    begin = time.perf_counter()
    rows, targets = [], []
    for t in trajectories:
        lags = [t.y[1:-1], t.y[:-2], t.u[2:], t.u[1:-1], t.u[:-2]]
        rows.append(np.concatenate(lags, axis=1))
        targets.append(t.y[2:])
    weights = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
    context.log(0, IMPORTED)
    context.log(1, time.perf_counter() - begin)
    return Model(weights)
"""
JAX = """
import time
BEGIN = time.perf_counter()
import jax
import jax.numpy as jnp
import numpy as np
IMPORTED = time.perf_counter() - BEGIN
UNITS = 8


def roll(weights, state, u):
    def step(x, now):
        x = jnp.tanh(weights["a"] @ x + weights["b"] @ now)
        return x, weights["c"] @ x
    return jax.lax.scan(step, state, u)[1]


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        begin = time.perf_counter()
        x = np.concatenate([past_u, u], axis=1)
        run = jax.jit(jax.vmap(lambda v: roll(self.weights, jnp.zeros(UNITS), v)))
        y = np.array(run(x), dtype=float)[:, past_u.shape[1]:]
        y[0, 0, 0] = time.perf_counter() - begin
        return y


def fit(trajectories, context):
    begin = time.perf_counter()
    random = np.random.default_rng(context.seed)
    shapes = {"a": (UNITS, UNITS), "b": (UNITS, context.nu), "c": (context.ny, UNITS)}
    weights = {k: jnp.asarray(0.3 * random.standard_normal(v)) for k, v in shapes.items()}
    data = [(jnp.asarray(t.u), jnp.asarray(t.y)) for t in trajectories]

    def loss(w):
        return sum(jnp.mean((roll(w, jnp.zeros(UNITS), u) - y) ** 2) for u, y in data)

    def descend(w, _):
        value, slope = jax.value_and_grad(loss)(w)
        return jax.tree.map(lambda p, g: p - 0.05 * g, w, slope), value

    weights, _ = jax.jit(lambda w: jax.lax.scan(descend, w, length=50))(weights)
    weights = jax.tree.map(np.asarray, weights)
    context.log(0, IMPORTED)
    context.log(1, time.perf_counter() - begin)
    return Model(weights)
"""
SOURCES = {"numpy": NUMPY, "jax": JAX}


@dataclass
class Clock:
    """Seconds inside the candidate."""

    imported: float = 0.0
    fit: float = 0.0
    simulate: float = 0.0

    @property
    def own(self) -> float:
        """Time of the candidate's own work."""
        return self.fit + self.simulate


@dataclass
class Watched:
    """A worker that reads the candidate's own clock out of its replies."""

    worker: Worker
    clock: Clock

    def fit(
        self, source: str, trajectories: Sequence[Trajectory], context: Context
    ) -> tuple[Array, str, float]:
        """As `Worker.fit`."""
        reply = self.worker.fit(source, trajectories, context)
        self.clock.imported, self.clock.fit = reply[0][0, 1], reply[0][1, 1]
        return reply

    def count_compiling(self) -> None:
        """As `Worker.count_compiling`."""
        self.worker.count_compiling()

    def load(self, source: str, model: bytes, context: Context) -> None:
        """As `Worker.load`."""
        self.worker.load(source, model, context)

    def dump(self) -> bytes:
        """As `Worker.dump`."""
        return self.worker.dump()

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """As `Worker.simulate`."""
        y = self.worker.simulate(past_u, past_y, u)
        self.clock.simulate += y[0, 0, 0]
        return y


class WatchedRunner(WorkerRunner):
    """A runner whose workers add to `clock`."""

    clock: Clock

    @contextmanager
    def open(self, libraries: frozenset[str], limits: Limits) -> Generator[Worker]:
        with super().open(libraries, limits) as worker:
            yield cast(Worker, Watched(worker, self.clock))


@dataclass
class InTurn:
    """Executor that runs one job after the other and keeps the wall time of each."""

    walls: list[float] = field(default_factory=list)

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of `jobs`."""
        return [self._timed(job) for job in jobs]

    def _timed(self, job: Callable[[], T]) -> T:
        begin = time.perf_counter()
        result = job()
        self.walls.append(time.perf_counter() - begin)
        return result


@dataclass(frozen=True)
class Times:
    """Seconds of one fold."""

    wall: float
    overhead: float
    imported: float
    reload: float
    bare: float


def main() -> int:
    """Measure, print a table, 1 when a limit is broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5, help="each of two folds")
    repeats = parser.parse_args().repeats
    found = probe()
    levels = list(dict.fromkeys([found.level, Isolation.PROCESS]))
    for note in found.notes:
        print(f"not available: {note}")
    print(f"{SAMPLES} samples, 2 folds, median over {repeats} repeats of each fold; seconds")
    print(f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} (fair up to 1)")
    heads = (
        "isolation",
        "candidate",
        "workers",
        "overhead",
        "limit",
        "",
        "of it imports",
        "reload check",
    )
    heads += ("fold", "bare", "fold/bare", "least overhead")
    lines: list[tuple[str, ...]] = [heads]
    broken = False
    for level in levels:
        for name, source, ahead in (
            (name, source, ahead) for name, source in SOURCES.items() for ahead in (False, True)
        ):
            times = _measure(level, source, repeats, ahead=ahead)
            middle = {k: median(getattr(t, k) for t in times) for k in Times.__annotations__}
            kept = middle["overhead"] <= LIMITS[name]
            broken = broken or not kept
            shown = [middle["overhead"], LIMITS[name], middle["imported"], middle["reload"]]
            words = [f"{v:.3f}" for v in (*shown, middle["wall"], middle["bare"])]
            words.insert(2, "ok" if kept else "OVER")
            ratio = f"{middle['wall'] / middle['bare']:.1f}"
            least = f"{min(t.overhead for t in times):.3f}"
            started = "ahead" if ahead else "when asked"
            lines.append((level.value, name, started, *words, ratio, least))
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    for line in lines:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    return 1 if broken else 0


def _measure(level: Isolation, source: str, repeats: int, *, ahead: bool) -> list[Times]:
    """Both folds of a small problem, so many times."""
    rule = ProtocolRule()
    records = (_record(),)
    folds = make_folds(records, rule)
    context = Context((Signal("u"),), (Signal("y"),), 0.1, rule.past_inputs, rule.past_outputs)
    bare = [_bare(source, fold, context, rule) for fold in folds]
    turns = InTurn()
    runner = WatchedRunner(level, Budget(), turns, standby=len(folds))
    evaluator = Evaluator(EvaluationData(folds, records, context, rule), runner)
    times: list[Times] = []
    with runner.ready_workers() if ahead else nullcontext():
        for _ in range(repeats):
            for fold, alone in zip(folds, bare, strict=True):
                times.append(_once(evaluator, runner, turns, source, fold, alone))
    return times


def _once(
    evaluator: Evaluator,
    runner: WatchedRunner,
    turns: InTurn,
    source: str,
    fold: Fold,
    bare: float,
) -> Times:
    """One fold."""
    evaluator.data = replace(evaluator.data, folds=(fold,))
    runner.clock, turns.walls = Clock(), []
    evaluation = evaluator.evaluate(source)
    if not isinstance(evaluation.outcome, Score):
        sys.exit(f"the candidate failed: {evaluation.outcome}")
    own, imported = runner.clock.own, runner.clock.imported
    runner.clock = Clock()
    # The clock in the first output makes the replies differ: the verdict is of no interest.
    evaluator.objection(source, evaluation)
    wall, again = turns.walls
    return Times(wall, wall - own, imported, again - runner.clock.simulate, bare)


def _bare(source: str, fold: Fold, context: Context, rule: ProtocolRule) -> float:
    """Seconds for the same calls in this process."""
    begin = time.perf_counter()
    module = ModuleType("candidate")
    exec(source, module.__dict__)
    model = module.fit(fold.train, context)
    for block in (*fold.held_out, *whole(fold.train, rule)):
        model.simulate(block.past_u[None], block.past_y[None], block.u[None])
    return time.perf_counter() - begin


def _record() -> Trajectory:
    """Second-order linear system with a little noise."""
    random = np.random.default_rng(0)
    u = random.standard_normal(SAMPLES)
    y = np.zeros(SAMPLES)
    for k in range(2, SAMPLES):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.2 * u[k] + 0.1 * u[k - 1]
    return Trajectory(u, y + 0.01 * random.standard_normal(SAMPLES), 0.1, "record")


if __name__ == "__main__":
    sys.exit(main())
