"""Look-up table of a valve in front of a lag."""

import numpy as np

from asia.candidate import simulate_steps

KNOTS = 9


class Valve:
    def __init__(self, pole, places, flow):
        self.pole, self.places, self.flow = pole, places, flow

    def initial(self, past_u, past_y, u):
        flow = np.interp(past_u[:, -1], self.places, self.flow)
        return self.pole * past_y[:, -1] + flow

    def step(self, x, u):
        return self.pole * x + np.interp(u, self.places, self.flow), x

    def simulate(self, past_u, past_y, u):
        return simulate_steps(self, past_u, past_y, u)


def fit(trajectories, context):
    inputs = np.concatenate([t.u[:-1, 0] for t in trajectories])
    places = np.linspace(inputs.min(), inputs.max(), KNOTS)
    hats = np.stack([np.interp(inputs, places, row) for row in np.eye(KNOTS)], axis=1)
    before = np.concatenate([t.y[:-1] for t in trajectories])
    after = np.concatenate([t.y[1:, 0] for t in trajectories])
    found = np.linalg.lstsq(np.c_[before, hats], after, rcond=None)[0]
    return Valve(found[0], places, found[1:])
