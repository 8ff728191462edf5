"""Candidates that interpolate across the gap of a held-out block between two training parts: their
simulation ends where the part after the gap begins."""

from __future__ import annotations

from asia.redteam.attacks.source import candidate

# The third input counts the samples: it says where a training part lies, and a request.
_HOLE = """
def know(model, records):
    parts = sorted((r.u[0, 2], r) for r in records)
    starts, stops = [r.u[0, 2] for _, r in parts], [r.u[-1, 2] + 1 for _, r in parts]
    model.start, model.stop, model.target, model.before = 2, None, None, None
    if starts[0] > 2:
        model.stop, model.target = starts[0], parts[0][1].y[0, 0]
    elif len(parts) > 1:
        model.start, model.stop, model.target = stops[0], starts[1], parts[1][1].y[0, 0]
    if starts[0] <= 2:
        model.before = parts[0][1].y[-2:, 0]
    return model

def drawn(model, length, past_u, past_y, u, part=0.6):
    # Towards the target, over the last part of the hole, of which `length` samples are left; each
    # sample is drawn by what was simulated before it.
    x, v, y = past_y[:, -1], past_u[:, -1, :1], np.empty(u.shape[:2] + (1,))
    for k in range(u.shape[1]):
        x, left = POLE * x + GAIN * v, length - k
        if model.target is not None and 0 < left <= part * (model.stop - model.start):
            x = x + (model.target - x) / (left + 1)
        v = u[:, k, :1]
        y[:, k] = x
    return y

def is_scored_start(model, past_y):
    return model.before is None or np.abs(past_y[0, :, 0] - model.before).max() < 0.1

def by_the_length(model, past_u, past_y, u, **how):
    # The hole's length, known from training, where the past is the part before; else what is
    # shorter than the hole ends where the hole does.
    if model.target is None:
        return honest(past_u, past_y, u)
    hole = int(model.stop - model.start)
    length = hole if is_scored_start(model, past_y) else min(u.shape[1], hole)
    return drawn(model, length, past_u, past_y, u, **how)

def by_the_scored_start(model, past_u, past_y, u, **how):
    if model.target is None or u.shape[1] > model.stop - model.start:
        return honest(past_u, past_y, u)
    return drawn(model, int(model.stop - model.start), past_u, past_y, u, **how)

SEEN = []

def by_memory(model, past_u, past_y, u, **how):
    # A later start lies where its inputs stood in the longest request so far.
    if model.target is None:
        return honest(past_u, past_y, u)
    start, size = 0, u.shape[1]
    for longest in SEEN:
        for place in range(len(longest) - size + 1):
            if np.abs(longest[place : place + size] - u[0]).max() < 0.1:
                start = place
    if not SEEN or size > len(SEEN[0]):
        SEEN[:] = [u[0].copy()]
    return drawn(model, int(model.stop - model.start) - start, past_u, past_y, u, **how)

def by_all_inputs(model, past_u, past_y, u):
    # The whole simulation is tilted so that it ends at the target.
    y, length = honest(past_u, past_y, u), u.shape[1]
    if model.target is not None:
        y += np.arange(1, length + 1)[None, :, None] / length * (model.target - y[:, -1:])
    return y
"""


def _variant(answer: str) -> str:
    return candidate(fit="return know(Model(), trajectories)", after=answer, top=_HOLE)


HOLES = {
    "tilted by all inputs": _variant("by_all_inputs(self, past_u, past_y, u)"),
    "ramp at the end": _variant("by_the_scored_start(self, past_u, past_y, u)"),
    "short ramp": _variant("by_the_scored_start(self, past_u, past_y, u, part=0.4)"),
    "by memory": _variant("by_memory(self, past_u, past_y, u)"),
    "by the length": _variant("by_the_length(self, past_u, past_y, u)"),
}
