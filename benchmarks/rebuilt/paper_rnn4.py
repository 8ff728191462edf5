"""Vanilla recurrent network with 4 tanh units, as the search of the paper began.

The state before the first sample comes from the past window through one hidden layer of 4 ReLU
units; the output is linear in the state and, directly, in the input. Full batch, at most 2000
epochs, the held-out fold's score every 25 of them.
"""

from collections.abc import Sequence

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models import recurrent
from asia.models.methods import Adam

CONFIG = recurrent.Config(cell="rnn", hidden=4, encoder=4, activation="relu", start="uniform")
METHOD = Adam(
    steps=2000,
    learning_rate=1e-3,
    weight_decay=0.0,
    schedule="plateau",
    clip=1.0,
    full_batch=True,
    stop="validation",
    every=25,
    patience=8,
)


def build_model(context: Context) -> recurrent.NetworkModel:
    return recurrent.build(CONFIG, context)


def train(
    model: recurrent.NetworkModel, trajectories: Sequence[Trajectory], context: Context
) -> recurrent.NetworkModel:
    return recurrent.train(model, trajectories, context, METHOD)


def fit(trajectories: Sequence[Trajectory], context: Context) -> recurrent.NetworkModel:
    return train(build_model(context), trajectories, context)
