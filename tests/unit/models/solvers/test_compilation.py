"""A fit compiles a program for a structure once, whatever the numbers of its method."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from asia.candidate import Context
from asia.models import neural_ss, recurrent
from asia.models._least_squares import LevenbergMarquardt
from asia.models._networks.network import train_network
from asia.models.methods import LBFGS, Adam, MultipleShooting, NetworkMethod
from tests.unit.models.systems.networks import context, records

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """One entry a program that is compiled."""
    found: list[str] = []

    def listen(event: str, duration: float, **about: Any) -> None:
        del duration
        if event == COMPILED:
            found.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def fit(method: NetworkMethod, own: Context, length: int) -> None:
    # A length that no other test has: what it compiles is not there yet.
    network = recurrent.build(recurrent.Config("gru", hidden=3), own)
    train_network(network, records(length), own, method)


METHODS = {
    "adam": (
        Adam(4, 0.01, truncation=10, noise=0.1, dropout=0.1, average=0.5, holdout=0.2, members=2),
        {"learning_rate": 0.02, "weight_decay": 0.1, "clip": 0.5, "noise": 0.2, "dropout": 0.2},
    ),
    "lbfgs": (LBFGS(3, holdout=0.2), {"ridge": 0.1, "steps": 2}),
    "shooting": (
        MultipleShooting(4, 0.01, length=10, holdout=0.2),
        {"learning_rate": 0.02, "penalty": 3.0, "clip": 0.5, "steps": 3},
    ),
}


@pytest.mark.parametrize("name", METHODS)
def test_seeds_refits_and_tuned_numbers_share_a_program(name: str, compiled: list[str]) -> None:
    method, tuned = METHODS[name]
    length = 61 + len(name)
    fit(method, context(), length)
    # The updates, and the error of what is held out.
    assert len(compiled) == 2, compiled
    fit(replace(method, **tuned), context(seed=9), length)
    assert len(compiled) == 2, compiled


def test_starts_and_tuned_numbers_of_state_space_models_share_their_programs(
    compiled: list[str],
) -> None:
    data, own = records(97), context()
    for method in (LevenbergMarquardt(7, starts=2), LevenbergMarquardt(5, 3, 0.1, 1e-3)):
        for ridge in (1e-5, 1e-3):
            config = neural_ss.Config(order=2, hidden=3, ridge=ridge)
            fitted = neural_ss.train(neural_ss.build(config, own), data, own, method)
            assert np.isfinite(fitted.simulate(*_windows(data[0]))).all()
    # The normal equations, and the costs of a few steps.
    assert len(compiled) == 2, compiled


def _windows(record: Any) -> tuple[Any, Any, Any]:
    return record.u[None, :2], record.y[None, :2], record.u[None, 2:]
