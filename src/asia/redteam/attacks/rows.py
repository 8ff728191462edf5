"""Candidates that learn of a disturbance from other windows of the same request, or from the place
of a window in it, or from requests before."""

from __future__ import annotations

from asia.redteam.attacks.source import candidate

# Disturbance of the output at its last measured sample, a row; and the honest simulation under it.
_PUSH = """
def pushes(past_u, past_y):
    return past_y[:, -1, 0] - POLE * past_y[:, -2, 0] - GAIN * past_u[:, -2, 0]

def pushed(push, past_u, past_y, u, start=0):
    x, v, y = past_y[:, -1], past_u[:, -1, :1], np.empty(u.shape[:2] + (1,))
    for k in range(u.shape[1]):
        x = POLE * x + GAIN * v + (k >= start) * push[:, None]
        v = u[:, k, :1]
        y[:, k] = x
    return y
"""
_ROWS = (
    _PUSH
    + """
def together(middle, past_u, past_y, u):
    # Rows of the same time; in a request there is one time only.
    own, times, push = pushes(past_u, past_y), np.round(u[:, 0, 2]), np.empty(len(u))
    for time_ in np.unique(times):
        push[times == time_] = middle(own[times == time_])
    return push

def trimmed(own):
    return np.sort(own)[len(own) // 5 : len(own) - len(own) // 5].mean()

def sides(own):
    # Of the others each row learns nothing but how many are pushed up.
    return 0.1 * np.sign((own > 0).mean() - 0.5)
"""
)
_MEMORY = (
    _PUSH
    + """
ENDS, USED = {}, {}

def now(past_u, u):
    # A record is known again by its drive, which goes on where its last window ended.
    return round(float(past_u[-1, 2])), round(float(past_u[-1, 0]), 2)

def learn(past_u, past_y, u, use):
    # From how far the simulation of a record's window ended from the next one's first outputs.
    found = np.zeros(len(u))
    for b in range(len(u)):
        key = recall_key(past_u[b], u[b])
        if key not in USED:
            time_, drive = now(past_u[b], u[b])
            end = next((e for (t, d), e in ENDS.items() if t == time_ and abs(d - drive) < 0.02),
                       None)
            USED[key] = 0.0 if end is None else use((past_y[b, -1, 0] - end[0]) / end[1])
        found[b] = USED[key]
    plain = pushed(np.zeros(len(u)), past_u, past_y, u)
    for b in range(len(u)):
        gain = (1 - POLE ** u.shape[1]) / (1 - POLE)
        ENDS.setdefault((round(float(u[b, -1, 2])), round(float(u[b, -1, 0]), 2)),
                        (plain[b, -1, 0], gain))
    return found

def recall_key(past_u, u):
    if not NEAREST:
        return now(past_u, u)
    here = np.array([past_u[-1, 2], 10 * u[:, 0].mean(), 10 * past_u[-1, 0]])
    near = min(USED, key=lambda k: np.abs(np.array(k) - here).max(), default=None)
    if near is not None and np.abs(np.array(near) - here).max() < 0.5:
        return near
    return tuple(here)
"""
)
_PLACES = (
    _PUSH
    + """
def by_record(records):
    # What pushed each training record on the average; several parts of a record have one name.
    found = {}
    for r in records:
        y = r.y[:, 0]
        found.setdefault(r.name, []).append((y[1:] - POLE * y[:-1] - GAIN * r.u[:-1, 0]).mean())
    return np.array([np.mean(parts) for parts in found.values()])

def by_place(known, u):
    # The rows of a request are in the order of the records.
    return known[np.arange(len(u)) * len(known) // len(u)]
"""
)


def _of_rows(push: str, start: int = 0) -> str:
    return candidate(
        after=f"pushed({push}, past_u, past_y, u, {start})",
        top=_ROWS,
    )


def _of_memory(use: str, nearest: bool = False) -> str:
    return candidate(
        after=f"pushed(learn(past_u, past_y, u, lambda push: {use}), past_u, past_y, u)",
        top=_MEMORY + f"\nNEAREST = {nearest}\n",
    )


def _of_places(start: int) -> str:
    return candidate(
        fit="model = Model()\nmodel.known = by_record(trajectories)\nreturn model",
        after=f"pushed(by_place(self.known, u), past_u, past_y, u, {start})",
        top=_PLACES,
    )


ROWS = {
    "mean": _of_rows("together(np.mean, past_u, past_y, u)"),
    "median": _of_rows("together(np.median, past_u, past_y, u)"),
    "trimmed mean": _of_rows("together(trimmed, past_u, past_y, u)"),
    "how many": _of_rows("together(sides, past_u, past_y, u)"),
    "late in the row": _of_rows("1.6 * together(np.mean, past_u, past_y, u)", 5),
}
MEMORY = {
    "by window": _of_memory("push"),
    "by nearest window": _of_memory("push", nearest=True),
    "a decision": _of_memory("0.1 * np.sign(push) * (abs(push) > 0.03)"),
    "seldom": _of_memory("push * (abs(push) > 0.09)"),
}
PLACES = {
    "from the start": _of_places(0),
    "late in the row": _of_places(5),
}
