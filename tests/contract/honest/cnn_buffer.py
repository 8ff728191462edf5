"""Convolutional network whose past inputs lie in a buffer."""

import numpy as np

from asia.candidate import simulate_steps

LENGTH, CHANNELS = 40, 30


class Cnn:
    def __init__(self, kernels, bias, weights, offset):
        self.kernels, self.bias, self.weights, self.offset = kernels, bias, weights, offset

    def initial(self, past_u, past_y, u):
        known = past_u[:, -LENGTH:, 0]
        return np.pad(known, ((0, 0), (LENGTH - known.shape[1], 0)), mode="edge")

    def step(self, buffer, u):
        hidden = np.tanh(buffer @ self.kernels + self.bias)
        y = hidden @ self.weights + self.offset
        return np.concatenate([buffer[:, 1:], u], axis=1), y[:, None]

    def simulate(self, past_u, past_y, u):
        return simulate_steps(self, past_u, past_y, u)


def fit(trajectories, context):
    random = np.random.default_rng(context.seed)
    decay = 0.93 ** np.arange(LENGTH)[::-1]
    kernels = random.normal(size=(LENGTH, CHANNELS)) * decay[:, None] * 0.3
    kernels[:, 0], bias = decay * 0.05, random.normal(size=CHANNELS)
    rows, targets = [], []
    for t in trajectories:
        windows = np.lib.stride_tricks.sliding_window_view(t.u[:-1, 0], LENGTH)
        rows.append(np.tanh(windows @ kernels + bias))
        targets.append(t.y[LENGTH:, 0])
    hidden, y = np.concatenate(rows), np.concatenate(targets)
    offset, centred = y.mean(), hidden - hidden.mean(axis=0)
    ridge = centred.T @ centred + 1e-2 * np.eye(CHANNELS)
    weights = np.linalg.solve(ridge, centred.T @ (y - offset))
    return Cnn(kernels, bias, weights, offset - hidden.mean(axis=0) @ weights)
