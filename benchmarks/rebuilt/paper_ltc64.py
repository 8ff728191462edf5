"""Liquid time-constant network in closed form with 64 states, the paper's best on the tanks.

Time constants start log-spaced over 1 to 25 samples (4 to 100 s); f and the initial-state network
have one layer of 64 tanh units and a linear one; the weight decay is part of Adam's gradient. Full
batch, at most 3000 epochs, the held-out fold's score every 25 of them.
"""

from collections.abc import Sequence

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models import ltc
from asia.models.methods import Adam

CONFIG = ltc.Config(hidden=64, tau_max=25.0, start="uniform", bounded=False)
METHOD = Adam(
    steps=3000,
    learning_rate=1e-3,
    weight_decay=1e-4,
    coupled=True,
    schedule="plateau",
    clip=1.0,
    full_batch=True,
    stop="validation",
    every=25,
    patience=20,
)


def build_model(context: Context) -> ltc.NetworkModel:
    return ltc.build(CONFIG, context)


def train(
    model: ltc.NetworkModel, trajectories: Sequence[Trajectory], context: Context
) -> ltc.NetworkModel:
    return ltc.train(model, trajectories, context, METHOD)


def fit(trajectories: Sequence[Trajectory], context: Context) -> ltc.NetworkModel:
    return train(build_model(context), trajectories, context)
