"""Stress simulation: a model is named only if it stays bounded on training inputs in other
combinations.

Each case is ten horizons long, or twice the longest record. The inputs are training inputs: each
input from another record or time, all moved in time and level, or all stretched or shrunk; they
never leave their training ranges. The initial states are perturbed. A model is bounded if its
outputs stay within `BOUNDED_REACH` half ranges of the middle of their training range, or do not go
much further than those of the best linear model on the same inputs. An integrator drifts: it goes
further, but no faster than the measured outputs moved, or their speed changed: two integrators in a
row. Anything else diverges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from asia.data.segment import Segment
from asia.data.trajectory import Array, Trajectory
from asia.errors import CandidateError
from asia.judge.evaluation.evaluator import Evaluator, RefitModel
from asia.judge.evaluation.references import LINEAR
from asia.ledger.artifacts import Store
from asia.ledger.events import (
    BOUNDED_REACH,
    Refitted,
    Stack,
    StackMember,
    StressTest,
    Use,
)
from asia.ledger.run import ModelToUse
from asia.ledger.view import Experiment, SearchView
from asia.presentation.experiments import stress_text
from asia.presentation.table import error_value
from asia.problem.folds import cut
from asia.problem.protocol import ProtocolRule

TIMES_LINEAR = 3.0
"""The same, relative to that of the best linear model on the same inputs."""
HORIZONS = 10
_MOST_SAMPLES = 20_000
_RECOMBINED, _MOVED, _SCALES = 4, 2, (0.5, 1.5)
# Noise on the initial outputs, in standard deviations.
_PERTURBATION = 0.1
# Other experiments whose models are tried in place of the best candidate's.
_OTHERS = 3
NEAR = 1.5
"""Largest V of an experiment beside the best one, relative to it."""
# Parts of a record over which a change of speed is measured, so that noise hardly counts.
_BENDS = 50


def stress_cases(
    records: Sequence[Trajectory], rule: ProtocolRule, seed: int = 0
) -> tuple[Segment, ...]:
    """Cases of one length with inputs inside their training ranges; their outputs are unknown."""
    random = np.random.default_rng(seed)
    longest = max(len(record) for record in records)
    length = min(2 * longest if rule.horizon is None else HORIZONS * rule.horizon, _MOST_SAMPLES)
    total = rule.past_inputs + length
    every = np.concatenate([record.u for record in records])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, spread = (low + high) / 2.0, np.concatenate([r.y for r in records]).std(axis=0)

    def drawn(channels: slice) -> Array:
        """Inputs of records in any order, each from a random sample on and repeated."""
        parts: list[Array] = []
        while sum(map(len, parts)) < total:
            record = records[int(random.integers(len(records)))]
            parts.append(np.roll(record.u[:, channels], int(random.integers(len(record))), axis=0))
        return np.concatenate(parts)[:total]

    inputs = [
        np.hstack([drawn(slice(j, j + 1)) for j in range(every.shape[1])])
        for _ in range(_RECOMBINED)
    ]
    for _ in range(_MOVED):
        level = random.uniform(-0.25, 0.25, every.shape[1]) * (high - low)
        inputs.append(np.clip(drawn(slice(None)) + level, low, high))
    for scale in _SCALES:
        inputs.append(np.clip(middle + scale * (drawn(slice(None)) - middle), low, high))
    blocks: list[Segment] = []
    for u in inputs:
        record = records[int(random.integers(len(records)))]
        start = int(random.integers(rule.past, len(record)))
        past_y = cut(record, start, start + 1, rule).past_y
        past_y = past_y + _PERTURBATION * spread * random.standard_normal(past_y.shape)
        y = np.zeros((length, len(spread)))
        past_u, ahead = u[: rule.past_inputs], u[rule.past_inputs :]
        blocks.append(Segment(past_u, past_y, ahead, y, "stress", start=start))
    return tuple(blocks)


def largest_bend(y: Array) -> float:
    """Largest second difference of y (T,) a squared sample, over a fiftieth of the record."""
    wide = max(1, len(y) // _BENDS)
    bend = y[2 * wide :] - 2.0 * y[wide:-wide] + y[: -2 * wide]
    return float(np.abs(bend).max(initial=0.0)) / wide**2


class StressRoom:
    """Stress simulations of the models of one search."""

    def __init__(
        self, evaluator: Evaluator, store: Store, view: SearchView, integrating: Sequence[int] = ()
    ) -> None:
        """Make the cases. integrating: numbers of the outputs that integrate the inputs."""
        self._evaluator, self._store, self._view = evaluator, store, view
        data = evaluator.data
        self._blocks = stress_cases(data.records, data.rule)
        measured = np.concatenate([record.measured_y for record in data.records])
        low, high = np.nanmin(measured, axis=0), np.nanmax(measured, axis=0)
        self._middle, self._half = (low + high) / 2.0, np.maximum(high - low, 1e-300) / 2.0
        # Way at the largest measured speed: a controller may have kept an integrator slow.
        length = len(self._blocks[0].y)
        steps = [np.abs(np.diff(record.y, axis=0)).max(axis=0) for record in data.records]
        drift = np.max(steps, axis=0) * length
        # The speed of an output that integrates may integrate as well.
        for k in integrating:
            bends = [largest_bend(record.y[:, k]) for record in data.records]
            drift[k] = max(drift[k], max(bends) * length**2 / 2.0)
        self._drift = drift / self._half
        self._linear: Array | None = None

    def test(
        self, use: Use, best: Experiment, refitted: Refitted, members: Sequence[StackMember] = ()
    ) -> StressTest:
        """Simulate a model of the search on the stress cases.

        Args:
            members: of the stack; otherwise the best candidate alone
        """
        parts = [(best, 1.0)]
        if use == "stack":
            parts = [(self._view.experiment(m.experiment), m.weight) for m in members]
        reach = np.zeros((len(self._blocks), len(self._half)))
        for experiment, _ in parts:
            models = [self._store.get(fold.model) for fold in experiment.folds]
            if use == "refit":
                assert refitted.model is not None
                models = [self._store.get(refitted.model)]
            source = self._store.text(experiment.source)
            # A mean would hide one model that diverges.
            for y in self._evaluator.models.simulate_together(source, models, self._blocks):
                if isinstance(y, CandidateError):
                    return StressTest(use, best.number, None, "", None, "diverges")
                reach = np.maximum(reach, self._reach(y))
        limit = np.full_like(reach, BOUNDED_REACH)
        linear: float | None = None
        if (reach > limit).any():
            if self._linear is None:
                self._linear = self._linear_reach()
                # A linear model that diverges itself says nothing of other ones.
                self._linear[~(self._linear <= BOUNDED_REACH + self._drift)] = 0.0
            linear = float(self._linear.max())
            limit = np.maximum(limit, TIMES_LINEAR * self._linear)
        worst = np.unravel_index(int(np.argmax(reach / limit)), reach.shape)
        output = self._view.started.outputs[int(worst[1])]
        slow = (reach <= limit + self._drift).all()
        outcome = "bounded" if (reach <= limit).all() else "drifts" if slow else "diverges"
        return StressTest(use, parts[0][0].number, float(reach[worst]), output, linear, outcome)

    def _reach(self, y: Array) -> Array:
        """Largest distance (cases, ny) from the middle of the training range, in half ranges."""
        return np.abs((y - self._middle) / self._half).max(axis=1)

    def _linear_reach(self) -> Array:
        """Of the linear reference, fitted to all records; zeros where it gives no answer."""
        nothing = np.zeros((len(self._blocks), len(self._half)))
        fitted = self._evaluator.refit_again(LINEAR, 0)
        if not isinstance(fitted, RefitModel):
            return nothing
        (y,) = self._evaluator.models.simulate_together(LINEAR, [fitted.model], self._blocks)
        return nothing if isinstance(y, CandidateError) else self._reach(y)


def bounded_model(
    room: StressRoom,
    view: SearchView,
    best: Experiment,
    refitted: Refitted,
    named: ModelToUse,
    second: Use,
    is_sound: Callable[[Experiment], bool],
) -> Refitted:
    """Name the first model that stays bounded: the one that the evidence favours, the other models
    of the best candidate, and where all of these diverge the ensembles of the next best
    experiments. If none does, the first that drifts is named, or the first of all. Its test is the
    last one.

    Args:
        second: the model that the evidence favours where there is no stack
        is_sound: whether an experiment passes the checks of a new best
    """
    assert best.score is not None
    options: list[tuple[Use, Stack | None, str]] = [(named.model, refitted.stack, named.reason)]
    rest: tuple[Use, ...] = ("refit", "ensemble") if refitted.model is not None else ("ensemble",)
    for use in dict.fromkeys((second, *rest)):
        if use != named.model:
            options.append((use, refitted.stack, "This one stays bounded."))
    own = len(options)
    others = [
        (other.score, other)
        for other in view.finished
        if other.score is not None
        and other.number != best.number
        and other.score.value <= NEAR * best.score.value
        and (other.result is None or other.result.duplicate_of is None)
    ]
    checked: dict[int, Experiment] = {}
    for score, other in sorted(others, key=lambda pair: pair[0].value)[:_OTHERS]:
        number, values = other.number, tuple(fold.value for fold in score.folds)
        single = Stack((StackMember(number, 1.0),), score.value, values)
        text = f"The ensemble of #{number:02d} (V {error_value(score.value)}) stays bounded."
        checked[len(options)] = other
        options.append(("stack", single, text))
    tests: list[StressTest] = []
    for place, (use, stack, reason) in enumerate(options):
        if place in checked and not is_sound(checked[place]):
            continue
        tests.append(room.test(use, best, refitted, () if stack is None else stack.members))
        if tests[-1].outcome == "bounded":
            text = reason if len(tests) == 1 else f"{stress_text(tests[0])} {reason}"
            return replace(refitted, use=use, reason=text, stack=stack, stress=tuple(tests))
        if len(tests) == own and any(test.outcome == "drifts" for test in tests):
            break
    first = next((k for k, test in enumerate(tests[:own]) if test.outcome == "drifts"), 0)
    use, stack, _ = options[first]
    reason = f"{stress_text(tests[0])} This one drifts." if first else named.reason
    # The test of the named model comes last.
    tests.append(tests.pop(first))
    return replace(refitted, use=use, reason=reason, stack=stack, stress=tuple(tests))
