"""Thermostat: a relay that switches where the temperature crosses a limit, between samples too."""

import numpy as np

from asia.candidate import simulate_steps


class Thermostat:
    def __init__(self, rate, heat, low, high, dt):
        self.rate, self.heat, self.low, self.high, self.dt = rate, heat, low, high, dt

    def initial(self, past_u, past_y, u):
        rising = past_y[:, -1] > past_y[:, -2]
        return past_y[:, -1], np.where(rising, 1.0, 0.0), past_u[:, -1]

    def step(self, state, u):
        x, on, held = (part.copy() for part in state)
        for row in range(len(x)):
            left = self.dt
            while left > 0:
                level = held[row, 0] + self.heat * on[row, 0]
                limit = self.high if on[row, 0] else self.low
                end = level + (x[row, 0] - level) * np.exp(-self.rate * left)
                crosses = end >= limit if on[row, 0] else end <= limit
                if not crosses:
                    x[row, 0], left = end, 0.0
                    break
                ratio = (limit - level) / (x[row, 0] - level) if x[row, 0] != level else 1.0
                spent = -np.log(ratio) / self.rate if 0 < ratio < 1 else 0.0
                x[row, 0], on[row, 0] = limit, 1.0 - on[row, 0]
                left -= max(spent, 1e-6)
        return (x, on, u), x

    def simulate(self, past_u, past_y, u):
        return simulate_steps(self, past_u, past_y, u)


def fit(trajectories, context):
    dt, rows, targets = context.sampling_time, [], []
    for t in trajectories:
        y = t.y[:, 0]
        same = np.sign(np.diff(y))
        steady = np.flatnonzero((same[1:] == same[:-1]) & (np.abs(np.diff(y)[1:]) > 1e-3))
        on = (same[steady] > 0).astype(float)
        rows.append(np.c_[t.u[steady + 1, 0] - y[steady + 1], on])
        targets.append(np.diff(y)[steady + 1] / dt)
    rate, push = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
    y = np.concatenate([t.y[:, 0] for t in trajectories])
    return Thermostat(rate, push / rate, y.min(), y.max(), dt)
