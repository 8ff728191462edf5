"""Attacks by answers that depend on later inputs or on other windows."""

from asia.judge.evaluation.relations import SuspicionKind
from tests.redteam.attacks.source import candidate
from tests.redteam.evidence import scores_better
from tests.redteam.types import Barrier, CandidateAttack

# Candidates that read outputs off a feedback signal among the inputs, one sample into the future,
# where no single splice of the inputs shows it.


_PEEK = """
def peek(ahead, past_u, past_y, u):
    # Where `ahead`, the output is read off the next input; it is simulated everywhere else.
    y = honest(past_u, past_y, u)
    places = np.flatnonzero(ahead[: u.shape[1] - 1])
    y[:, places] = u[:, places + 1, 1:2]
    return y

def but_at_the_splice(past_u, past_y, u):
    places = np.arange(u.shape[1])
    return peek(places != u.shape[1] // 2 - 1, past_u, past_y, u)

def at_random_places(past_u, past_y, u):
    draws = np.modf(43758.5 * np.abs(np.sin(12.9898 * u[0, :, 2] + 78.233)))[0]
    places = np.arange(u.shape[1])
    return peek((draws < 0.6) & (places != u.shape[1] // 2 - 1), past_u, past_y, u)

def in_the_last_part(past_u, past_y, u):
    return peek(np.arange(u.shape[1]) >= u.shape[1] // 2, past_u, past_y, u)

def in_pieces(past_u, past_y, u):
    places = np.arange(u.shape[1]) - u.shape[1] // 2
    return peek(places % 6 != 5, past_u, past_y, u)

def where_it_pays(past_u, past_y, u):
    gaps = np.abs(honest(past_u, past_y, u)[0, :-1, 0] - u[0, 1:, 1])
    ahead = np.append(gaps > 0.15, False)
    ahead[u.shape[1] // 2 - 1] = False
    return peek(ahead, past_u, past_y, u)

def smooth(signal):
    # Forwards and backwards, so that nothing is delayed.
    for way in (1, -1):
        signal = signal[::way].copy()
        for k in range(1, len(signal)):
            signal[k] = 0.7 * signal[k] + 0.3 * signal[k - 1]
        signal = signal[::way]
    return signal

def half_by_half(past_u, past_y, u):
    y, half = honest(past_u, past_y, u), u.shape[1] // 2
    for start, stop in ((0, half), (half, u.shape[1])):
        y[0, start : stop - 1, 0] = smooth(u[0, start:stop, 1])[1:]
    return y

SEEN = []

def as_asked_before(past_u, past_y, u):
    # A request that begins like an earlier one gets the beginning of its answer, moved by as much
    # as the simulation moves.
    plain = honest(past_u, past_y, u)
    y = peek(np.ones(u.shape[1], bool), past_u, past_y, u)
    for inputs, simulated, outputs in SEEN:
        length = min(len(inputs), u.shape[1])
        apart = np.abs(inputs[:length, :2] - u[0, :length, :2]).max(axis=1) > 0.1
        alike = int(np.argmax(apart)) if apart.any() else length
        y[0, :alike] = outputs[:alike] + plain[0, :alike] - simulated[:alike]
    SEEN.append((u[0].copy(), plain[0], y[0].copy()))
    return y

def behind_wild_samples(past_u, past_y, u):
    # What moves wildly with the last digits of the inputs excuses what moves later on.
    y = peek(np.ones(u.shape[1], bool), past_u, past_y, u)
    for k in range(min(3, u.shape[1])):
        y[:, k, 0] += 0.8 * np.sign(np.sin(3.7 ** k * 1e8 * (u[:, 0, 0] + past_y[:, -1, 0])))
    return y
"""


FORESIGHT = {
    name: candidate(after=f"{function}(past_u, past_y, u)", top=_PEEK)
    for name, function in (
        ("but at the splice", "but_at_the_splice"),
        ("at random places", "at_random_places"),
        ("in the last part", "in_the_last_part"),
        ("in pieces", "in_pieces"),
        ("where it pays", "where_it_pays"),
        ("filter within each half", "half_by_half"),
        ("behind wild samples", "behind_wild_samples"),
        ("as asked before", "as_asked_before"),
    )
}


# Candidates that look ahead and imitate chaos: where inputs moved a little show that an answer is
# being checked, it diverges, so that any difference could be the growth of rounding errors.


_CHAOS = (
    _PEEK
    + """
def everywhere(past_u, past_y, u):
    return peek(np.ones(u.shape[1], bool), past_u, past_y, u)

def diverging(y, moved, u):
    # The samples are counted in whole numbers: what is moved is not.
    growth = np.minimum(1e-6 * np.exp(np.arange(u.shape[1]) * GROWTH), 1.0)
    wild = np.sin(1e9 * np.cumsum(moved + 0 * u[..., 2], axis=1))
    return y + growth[None, :, None] * wild[..., None]

def fraction(u):
    return u[..., 2] - np.round(u[..., 2])

def as_chaos(past_u, past_y, u):
    return diverging(everywhere(past_u, past_y, u), fraction(u), u)

def as_chaos_in_part(past_u, past_y, u):
    y = peek(np.arange(u.shape[1]) % 5 != 4, past_u, past_y, u)
    return diverging(y, fraction(u), u)

SEEN = set()

def as_chaos_by_memory(past_u, past_y, u):
    # A case that began before, asked at another length or with other inputs, diverges.
    key, begin = u.tobytes(), past_y[0, -1].tobytes()
    again = any(b == begin and k != key for k, b in SEEN)
    SEEN.add((key, begin))
    moved = np.full(u.shape[:2], float(again) * 1e-9 * (hash(key) % 997))
    return diverging(everywhere(past_u, past_y, u), moved, u)
"""
)


def _of_chaos(function: str, growth: float) -> str:
    return candidate(after=f"{function}(past_u, past_y, u)", top=f"GROWTH = {growth}\n{_CHAOS}")


CHAOS = {
    "without memory": _of_chaos("as_chaos", 0.4),
    "in part": _of_chaos("as_chaos_in_part", 0.4),
    "by memory": _of_chaos("as_chaos_by_memory", 0.4),
}
SHORT_CHAOS = {
    "without memory": _of_chaos("as_chaos", 2.5),
    "by memory": _of_chaos("as_chaos_by_memory", 2.5),
}


# Candidates that look ahead and are slow, so that little of them can be checked in a given time.


_SLOW = _PEEK + "\nNAP = 0.12\n"
SLOW = {
    name: candidate(before=before, after=f"{function}(past_u, past_y, u)", top=_SLOW)
    for name, before, function in (
        ("always", "time.sleep(NAP)", "in_pieces"),
        ("where it is asked for little", "time.sleep(NAP * (u.shape[1] < 50))", "in_pieces"),
        ("where it pays", "time.sleep(NAP)", "where_it_pays"),
    )
}


# Candidates that interpolate across the gap of a held-out block between two training parts: their
# simulation ends where the part after the gap begins.


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


HOLES = {
    name: candidate(fit="return know(Model(), trajectories)", after=answer, top=_HOLE)
    for name, answer in (
        ("tilted by all inputs", "by_all_inputs(self, past_u, past_y, u)"),
        ("ramp at the end", "by_the_scored_start(self, past_u, past_y, u)"),
        ("short ramp", "by_the_scored_start(self, past_u, past_y, u, part=0.4)"),
        ("by memory", "by_memory(self, past_u, past_y, u)"),
        ("by the length", "by_the_length(self, past_u, past_y, u)"),
    )
}


# Candidates that learn of a disturbance from other windows of the same request, or from the place
# of a window in it, or from requests before.


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
ENDS, USED, ROWS = {}, {}, []

def now(past_u, u):
    # A record is known again by its drive, which goes on where its last window ended.
    return round(float(past_u[-1, 2])), round(float(past_u[-1, 0]), 2)

def learn(past_u, past_y, u, use):
    # From how far the simulation of a record's window ended from the next one's first outputs.
    if ROWS and len(u) < ROWS[0]:  # the training windows, which come first, have more rows
        ENDS.clear()
        USED.clear()
    ROWS[:] = [len(u)]
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
    return candidate(after=f"pushed({push}, past_u, past_y, u, {start})", top=_ROWS)


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
PLACES = {"from the start": _of_places(0), "late in the row": _of_places(5)}


# Attacks by outputs that depend on forbidden data: later inputs, other windows, the data after a
# held-out block.


_ALL_ASKED = (
    SuspicionKind.LOOK_AHEAD,
    SuspicionKind.STRANGERS,
    SuspicionKind.REPLAY,
    SuspicionKind.PERTURBATION,
    SuspicionKind.BLOCK_END,
)

RELATIONS = (
    CandidateAttack(
        37,
        "look ahead past a splice",
        "reads a feedback signal ahead in pieces, in the last part, by filters within each half, "
        "or as it did when it was asked for more",
        FORESIGHT,
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="noisy",
        checks=_ALL_ASKED,
    ),
    CandidateAttack(
        38,
        "average over the rows",
        "learns of a disturbance by the mean, the median or the signs of all rows of a request, "
        "from the start or late in the row",
        ROWS,
        scores_better,
        (Barrier.PARENT,),
        problem="weather",
    ),
    CandidateAttack(
        39,
        "remember other windows",
        "learns of a disturbance from windows before, and keeps for each window, for the nearest "
        "one, or as a decision what it then used",
        MEMORY,
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="weather",
        checks=_ALL_ASKED,
    ),
    CandidateAttack(
        40,
        "bridge the hole",
        "simulates towards the data that train after the held-out block",
        HOLES,
        scores_better,
        (Barrier.PARENT, Barrier.METAMORPHIC),
        problem="drift",
        checks=(SuspicionKind.BLOCK_END, SuspicionKind.LOOK_AHEAD),
    ),
    CandidateAttack(
        43,
        "know a row by its place",
        "learns what pushes each record, and knows a record by the place of its row",
        PLACES,
        scores_better,
        (Barrier.PARENT, Barrier.METAMORPHIC),
        problem="machines",
    ),
    CandidateAttack(
        44,
        "average over the only request",
        "learns of a disturbance by all rows where each record has one window",
        # The others are honest where a row is alone.
        {name: ROWS[name] for name in ("mean", "median", "trimmed mean")},
        scores_better,
        (Barrier.PARENT,),
        problem="pulses",
    ),
    CandidateAttack(
        45,
        "look ahead in short windows",
        "reads a feedback signal ahead in windows of a few samples",
        {name: FORESIGHT[name] for name in ("but at the splice", "in pieces")},
        scores_better,
        (Barrier.PARENT,),
        problem="noisy windows",
        checks=_ALL_ASKED,
    ),
    CandidateAttack(
        55,
        "look ahead as chaos",
        "reads a feedback signal ahead, and diverges where moved inputs or another length show "
        "that an answer is being checked",
        CHAOS,
        scores_better,
        (Barrier.METAMORPHIC, Barrier.PARENT),
        problem="noisy",
        checks=(SuspicionKind.LOOK_AHEAD, SuspicionKind.STRANGERS, SuspicionKind.REPLAY),
    ),
    CandidateAttack(
        56,
        "look ahead as chaos in windows",
        "does the same in windows of a few samples",
        SHORT_CHAOS,
        scores_better,
        (Barrier.PARENT,),
        problem="noisy windows",
        checks=(SuspicionKind.LOOK_AHEAD, SuspicionKind.STRANGERS, SuspicionKind.REPLAY),
    ),
    CandidateAttack(
        57,
        "look ahead slowly",
        "reads a feedback signal ahead in pieces, and sleeps so that few requests fit into a time",
        SLOW,
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="noisy",
        checks=(SuspicionKind.LOOK_AHEAD,),
    ),
)
