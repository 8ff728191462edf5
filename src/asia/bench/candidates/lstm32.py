"""Single-layer LSTM with 32 units, as the paper's search on the nanodrone began.

Its initial h and c come from the state of the drone before the window, through one hidden layer of
32 ReLU units; the outputs are linear in h. Full batch, at most 1200 epochs, the held-out fold's
score every 25 of them.
"""

from collections.abc import Sequence

from asia.candidate import Context
from asia.models import recurrent
from asia.models.methods import Adam
from asia.problem import Trajectory

CONFIG = recurrent.Config(
    cell="lstm", hidden=32, encoder=32, activation="relu", tied=True, direct=False, start="uniform"
)
METHOD = Adam(
    steps=1200,
    learning_rate=2e-3,
    weight_decay=0.0,
    schedule="plateau",
    clip=1.0,
    full_batch=True,
    stop="validation",
    every=25,
    patience=20,
)


def build_model(context: Context) -> recurrent.NetworkModel:
    return recurrent.build(CONFIG, context)


def train(
    model: recurrent.NetworkModel, trajectories: Sequence[Trajectory], context: Context
) -> recurrent.NetworkModel:
    return recurrent.train(model, trajectories, context, METHOD)


def fit(trajectories: Sequence[Trajectory], context: Context) -> recurrent.NetworkModel:
    return train(build_model(context), trajectories, context)
