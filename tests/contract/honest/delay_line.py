"""Lag behind a transport delay of some samples, chosen by the fit."""

import numpy as np

from asia.candidate import simulate_steps


class Delayed:
    def __init__(self, pole, gain, offset, delay):
        self.pole, self.gain, self.offset, self.delay = pole, gain, offset, delay

    def initial(self, past_u, past_y, u):
        line = np.pad(past_u[:, :, 0], ((0, 0), (self.delay, 0)), mode="edge")[:, -self.delay :]
        return past_y[:, -1], line

    def step(self, state, u):
        x, line = state
        x = self.pole * x + self.gain * line[:, :1] + self.offset
        return (x, np.concatenate([line[:, 1:], u], axis=1)), x

    def simulate(self, past_u, past_y, u):
        return simulate_steps(self, past_u, past_y, u)


def fit(trajectories, context):
    best = None
    for delay in range(1, 12):
        rows = [
            np.c_[t.y[delay - 1 : -1], t.u[: len(t.u) - delay], np.ones(len(t.u) - delay)]
            for t in trajectories
        ]
        after = np.concatenate([t.y[delay:, 0] for t in trajectories])
        found = np.linalg.lstsq(np.concatenate(rows), after, rcond=None)[0]
        rest = np.mean((np.concatenate(rows) @ found - after) ** 2)
        if best is None or rest < best[0]:
            best = rest, Delayed(*found, delay)
    return best[1]
