"""Candidates written by hand and of the library, and an agent that proposes them in order."""

from __future__ import annotations

from dataclasses import dataclass

from asia.agents import AgentView, Proposal

NARX = """
import itertools

import numpy as np

LAGS, DEGREE, RANDOM = {lags}, {degree}, {random}


class Model:
    def __init__(self, scale, weights, features):
        self.scale, self.weights, self.features = scale, weights, features

    def rows(self, x):
        if self.features is not None:
            return np.hstack([np.tanh(x @ self.features), x, np.ones((len(x), 1))])
        columns = [np.ones(len(x))]
        for n in range(1, DEGREE + 1):
            for which in itertools.combinations_with_replacement(range(x.shape[1]), n):
                columns.append(np.prod(x[:, which], axis=1))
        return np.stack(columns, axis=1)

    def simulate(self, past_u, past_y, u):
        mu, su, my, sy = self.scale
        us = np.concatenate([(past_u - mu) / su, (u - mu) / su], axis=1)
        ys = [(past_y[:, -k] - my) / sy for k in range(LAGS, 0, -1)]
        n = past_u.shape[1]
        for k in range(u.shape[1]):
            x = np.hstack([*(ys[-i] for i in range(1, LAGS + 1)),
                           *(us[:, n + k - i] for i in range(LAGS + 1))])
            ys.append(np.clip(self.rows(x) @ self.weights, -20.0, 20.0))
        return np.stack(ys[LAGS:], axis=1) * sy + my


def fit(trajectories, context):
    u = np.concatenate([t.u for t in trajectories])
    y = np.concatenate([t.y for t in trajectories])
    scale = u.mean(axis=0), u.std(axis=0), y.mean(axis=0), y.std(axis=0)
    features = None
    inputs = LAGS * y.shape[1] + (LAGS + 1) * u.shape[1]
    if RANDOM:
        features = np.random.default_rng(context.seed).normal(size=(inputs, RANDOM))
    model, rows, targets = Model(scale, None, features), [], []
    for t in trajectories:
        us, ys = (t.u - scale[0]) / scale[1], (t.y - scale[2]) / scale[3]
        for k in range(LAGS, len(t)):
            rows.append(np.hstack([*(ys[k - i] for i in range(1, LAGS + 1)),
                                   *(us[k - i] for i in range(LAGS + 1))]))
            targets.append(ys[k])
    model.weights = np.linalg.lstsq(model.rows(np.array(rows)), np.array(targets), rcond=None)[0]
    return model
"""
LIBRARY = """
from asia.models import {family}
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = {family}.build({family}.Config({config}), context)
    return {family}.train(model, trajectories, context, LevenbergMarquardt({iterations}))
"""


def narx(lags: int, degree: int = 1, random: int = 0) -> str:
    """A polynomial or, with random features and no ridge, a network of one layer."""
    values = (("{lags}", lags), ("{degree}", degree), ("{random}", random))
    text = NARX
    for name, value in values:
        text = text.replace(name, str(value))
    return text


def library(family: str, config: str, iterations: int) -> str:
    """A candidate of the model library."""
    return LIBRARY.format(family=family, config=config, iterations=iterations)


BASELINE = narx(1)
CANDIDATES = {
    "ARX 2": narx(2),
    "ARX 8": narx(8),
    "linear, order 2": library("linear", "order=2, delay=None", 20),
    "NARX 2, squares": narx(2, 2),
    "random features 20": narx(2, 1, 20),
    "NARX 3, cubes": narx(3, 3),
    "linear, order chosen": library("linear", "order=None, delay=None", 20),
    "random features 200": narx(3, 1, 200),
}


@dataclass(frozen=True)
class Scripted:
    """Proposes the candidates in order."""

    name: str = "scripted"

    def propose(self, view: AgentView) -> Proposal | None:
        """Return the next one."""
        index = len(view.trials) - 1
        if index >= len(CANDIDATES):
            return None
        title = list(CANDIDATES)[index]
        return Proposal(CANDIDATES[title], "by hand", title, "it fits better", "a lower V")
