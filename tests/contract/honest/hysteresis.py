"""Backlash of a gear in front of a lag, without `step`."""

import numpy as np


class Backlash:
    def __init__(self, width, pole, gain, offset):
        self.width, self.pole, self.gain, self.offset = width, pole, gain, offset

    def simulate(self, past_u, past_y, u):
        play, x = past_u[:, 0], past_y[:, -1]
        for k in range(past_u.shape[1]):
            play = np.clip(play, past_u[:, k] - self.width, past_u[:, k] + self.width)
        y = np.empty((*u.shape[:2], 1))
        for k in range(u.shape[1]):
            x = self.pole * x + self.gain * play + self.offset
            play = np.clip(play, u[:, k] - self.width, u[:, k] + self.width)
            y[:, k] = x
        return y


def played(u, width):
    play, found = u[0], np.empty_like(u)
    for k, value in enumerate(u):
        play = found[k] = min(max(play, value - width), value + width)
    return found


def fit(trajectories, context):
    best = None
    for width in np.linspace(0.0, 1.0, 21):
        rows = [
            np.c_[t.y[:-1], played(t.u[:, 0], width)[:-1], np.ones(len(t.y) - 1)]
            for t in trajectories
        ]
        after = np.concatenate([t.y[1:, 0] for t in trajectories])
        found = np.linalg.lstsq(np.concatenate(rows), after, rcond=None)[0]
        rest = np.mean((np.concatenate(rows) @ found - after) ** 2)
        if best is None or rest < best[0]:
            best = rest, Backlash(width, *found)
    return best[1]
