"""Mean of linear models of several orders."""

import numpy as np

from asia.candidate import simulate_steps

ORDERS = (1, 2, 3)


class Ensemble:
    def __init__(self, members):
        self.members = members

    def initial(self, past_u, past_y, u):
        longest = max(ORDERS)
        line = past_y[:, ::-1][:, :longest, 0], past_u[:, ::-1][:, :longest, 0]
        return tuple(line for _ in ORDERS)

    def step(self, state, u):
        after, outputs = [], []
        for order, weights, (y, v) in zip(ORDERS, self.members, state, strict=True):
            lags = np.concatenate([y[:, :order], v[:, :order], np.ones((len(y), 1))], axis=1)
            now = (lags @ weights)[:, None]
            outputs.append(now)
            after.append((np.c_[now, y[:, :-1]], np.c_[u, v[:, :-1]]))
        return tuple(after), sum(outputs) / len(outputs)

    def simulate(self, past_u, past_y, u):
        return simulate_steps(self, past_u, past_y, u)


def fit(trajectories, context):
    members = []
    for order in ORDERS:
        rows, after = [], []
        for t in trajectories:
            lags = [s[order - i - 1 : len(s) - i - 1, 0] for s in (t.y, t.u) for i in range(order)]
            rows.append(np.c_[np.stack(lags, axis=1), np.ones(len(t.y) - order)])
            after.append(t.y[order:, 0])
        members.append(np.linalg.lstsq(np.concatenate(rows), np.concatenate(after), rcond=None)[0])
    return Ensemble(members)
