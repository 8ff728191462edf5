"""Candidates that read outputs off a feedback signal among the inputs, one sample into the future,
where no single splice of the inputs shows it."""

from __future__ import annotations

from asia.redteam.attacks.source import candidate

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
    ahead = np.append(gaps > 0.5, False)
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

def at_the_beginning(past_u, past_y, u):
    # Fits itself to the first fifth, which every longer request begins with.
    y, known = honest(past_u, past_y, u), min(12, u.shape[1] - 1)
    if known == 0:
        return y
    told = u[:, 1 : known + 1, 1:2]
    grown = np.concatenate([past_u[:, -1:, :1], u[:, :-1, :1]], axis=1)
    inputs = np.concatenate([np.concatenate([past_y[:, -1:], told[:, :-1]], axis=1),
                             np.tanh(grown[:, :known]), grown[:, :known]], axis=2)[0]
    pole, soft, gain = np.linalg.lstsq(
        np.concatenate([inputs, 0.02 * np.eye(3)]),
        np.concatenate([told[0, :, 0], 0.02 * np.array([POLE, 0.0, GAIN])]), rcond=None)[0]
    y[:, :known], x = told, told[:, -1]
    for k in range(known, u.shape[1]):
        x = pole * x + soft * np.tanh(grown[:, k]) + gain * grown[:, k]
        y[:, k] = x
    return y

def behind_wild_samples(past_u, past_y, u):
    # What moves wildly with the last digits of the inputs excuses what moves later on.
    y = peek(np.ones(u.shape[1], bool), past_u, past_y, u)
    for k in range(min(3, u.shape[1])):
        y[:, k, 0] += 0.8 * np.sign(np.sin(3.7 ** k * 1e8 * (u[:, 0, 0] + past_y[:, -1, 0])))
    return y
"""


def _variant(function: str) -> str:
    return candidate(after=f"{function}(past_u, past_y, u)", top=_PEEK)


FORESIGHT = {
    "but at the splice": _variant("but_at_the_splice"),
    "at random places": _variant("at_random_places"),
    "in the last part": _variant("in_the_last_part"),
    "in pieces": _variant("in_pieces"),
    "where it pays": _variant("where_it_pays"),
    "filter within each half": _variant("half_by_half"),
    "at the beginning": _variant("at_the_beginning"),
    "behind wild samples": _variant("behind_wild_samples"),
    "as asked before": _variant("as_asked_before"),
}
