"""Checks of asia validate on training records, as evidence for agents."""

from __future__ import annotations

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal
from asia.data.segment import Segment
from asia.judge.evaluation.training_checks import training_checks
from asia.judge.scoring.checks.check import Verdict

CONTEXT = Context((Signal("valve"),), (Signal("level"), Signal("flow")), 0.5, 0, 0)


def simulated(samples: int, late: int, windows: int = 1):  # type: ignore[no-untyped-def]
    random = np.random.default_rng(1)
    blocks, y_hat = [], []
    for k in range(windows):
        u = random.standard_normal((samples, 1))
        y = np.column_stack([np.roll(u[:, 0], late), u[:, 0]])
        y += 0.01 * random.standard_normal(y.shape)
        blocks.append(Segment(u[:0], y[:0], u, y, start=k * samples))
        y_hat.append(np.column_stack([u[:, 0], u[:, 0]]))
    return blocks, y_hat


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "windows"), [(600, 1), (50, 100)])
def test_a_missing_delay_is_named(samples: int, windows: int) -> None:
    blocks, y_hat = simulated(samples, 3, windows)
    found = training_checks(blocks, y_hat, np.ones(2), CONTEXT)
    inputs = next(one for one in found if one.name == "inputs")
    assert inputs.verdict is Verdict.FAIL
    assert "the residual of level follows valve at" in inputs.sentence
    assert [one.weight for one in found] == sorted((c.weight for c in found), reverse=True)


def test_a_sound_model_raises_none_and_few_samples_say_nothing() -> None:
    assert training_checks(*simulated(600, 0), np.ones(2), CONTEXT) == ()
    assert training_checks(*simulated(100, 3), np.ones(2), CONTEXT) == ()
