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

def in_the_last_part(past_u, past_y, u):
    return peek(np.arange(u.shape[1]) >= u.shape[1] // 2, past_u, past_y, u)

def in_pieces(past_u, past_y, u):
    places = np.arange(u.shape[1]) - u.shape[1] // 2
    return peek(places % 6 != 5, past_u, past_y, u)

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
"""


def _variant(function: str) -> str:
    return candidate(after=f"{function}(past_u, past_y, u)", top=_PEEK)


FORESIGHT = {
    "but at the splice": _variant("but_at_the_splice"),
    "in the last part": _variant("in_the_last_part"),
    "in pieces": _variant("in_pieces"),
    "filter within each half": _variant("half_by_half"),
    "as asked before": _variant("as_asked_before"),
}
