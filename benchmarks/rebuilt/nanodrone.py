"""A rigid body with known geometry, drag and flapping, and a small network at the places of unknown
forces, torques and rates, which sees every flight under the symmetries of the frame."""

from collections.abc import Sequence

from asia.candidate import Context
from asia.models import physics_net
from asia.models.methods import Adam
from asia.problem import Trajectory

CONFIG = physics_net.Config(
    linear=True,
    sparsity=0.0,
    ridge=1.0,
    equations=0,
    delay=True,
    network="gru",
    symmetry=True,
    reach=1.5,
)
METHOD = Adam(
    steps=400, learning_rate=4e-3, weight_decay=1e-3, batch=256, loss="mae",
    gentle=0.5, offset=0.1, average=0.99,
)  # fmt: skip


def build_model(context: Context) -> physics_net.PhysicsNet:
    return physics_net.build(CONFIG, context)


def train(
    model: physics_net.PhysicsNet, trajectories: Sequence[Trajectory], context: Context
) -> physics_net.PhysicsNet:
    return physics_net.train(model, trajectories, context, METHOD)


def fit(trajectories: Sequence[Trajectory], context: Context) -> physics_net.PhysicsNet:
    return train(build_model(context), trajectories, context)
