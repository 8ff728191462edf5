"""Two alike tanks, the upper one running over into the lower one, behind a bent level sensor.

What leaves the upper tank arrives late; the law of the lower tank's outflow is smoothly corrected.
The residual counts as a slow disturbance and white noise. Priors are the problem's.
"""

from asia.models import greybox
from asia.models._least_squares import LevenbergMarquardt

CONFIG = greybox.Config(
    saturation=("x1",),
    spill=True,
    sensor="power",
    lag=("x1",),
    smooth=("x2",),
    smooth_width=0.15,
)
METHOD = LevenbergMarquardt(iterations=60, starts=12, noise_model="slow", huber=3.0)


def build_model(context):
    return greybox.build(CONFIG, context)


def train(model, trajectories, context):
    return greybox.train(model, trajectories, context, METHOD)


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
