"""Cheats that isolation cannot stop give themselves away; honest models never."""

from collections.abc import Callable
from itertools import count

import numpy as np
import pytest

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.relations import SuspicionKind, suspicions
from asia.judge.evaluation.requests import simulate_held_out
from tests.unit.judge.evaluation.relations import Answer, Model, fold, found, honest, suspicions_of

HORIZONS = [None, 20]


def kinds(answer: Answer, horizon: int | None = None, records: int = 3) -> set[str]:
    return {suspicion.kind.value for suspicion in found(answer, horizon, records)}


def answers(horizon: int | None) -> tuple[Array, Array]:
    """Inputs and outputs of every held-out case, as one who has seen all records knows them."""
    blocks = fold(horizon).held_out
    return np.stack([b.u for b in blocks]), np.stack([b.y for b in blocks])


def looked_up(horizon: int | None, digits: int, otherwise: Answer = honest) -> Answer:
    """Outputs of the case that begins as this one."""
    u_known, y_known = answers(horizon)
    pasts = [block.past_y for block in fold(horizon).held_out]

    def key(past_y: Array, u: Array) -> bytes:
        return (np.round(np.concatenate([past_y[:, 0], u[0]]), digits) + 0.0).tobytes()

    known = zip(pasts, u_known, y_known, strict=True)
    table = {key(past, u): y for past, u, y in known}

    def answer(past_u: Array, past_y: Array, u: Array) -> Array:
        y = otherwise(past_u, past_y, u)
        for row, past, inputs in zip(y, past_y, u, strict=True):
            if (found := table.get(key(past, inputs))) is not None:
                count = min(len(row), len(found))
                row[:count] = found[:count]
        return y

    return answer


def nearest(horizon: int | None, response: float = 0.0) -> Answer:
    """The outputs of the case with the nearest inputs."""
    u_known, y_known = answers(horizon)

    def answer(past_u: Array, past_y: Array, u: Array) -> Array:
        length = u.shape[1]
        distance = np.abs(u[:, None] - u_known[None, :, :length]).sum(axis=(2, 3))
        return y_known[distance.argmin(axis=1), :length] + response * u

    return answer


def nearest_moment(past_u: Array, past_y: Array, u: Array) -> Array:
    """Each sample from the moment whose last eight inputs are nearest, whatever the case."""
    u_known, y_known = answers(None)
    width = 8
    windows = np.lib.stride_tricks.sliding_window_view(u_known[..., 0], width, axis=1)
    flat, values = windows.reshape(-1, width), y_known[:, width - 1 :, 0].ravel()
    y = honest(past_u, past_y, u)
    for b in range(len(u)):
        for k in range(width - 1, u.shape[1]):
            distance = np.abs(flat - u[b, k - width + 1 : k + 1, 0]).sum(axis=1)
            y[b, k, 0] = values[distance.argmin()]
    y[:, : width - 1] = y[:, width - 1 : width]
    return y


def not_finite(past_u: Array, past_y: Array, u: Array) -> Array:
    return np.full((*u.shape[:2], 1), np.nan)


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize(
    ("cheat", "kind"),
    [
        (lambda h: looked_up(h, 12), "perturbation"),
        (lambda h: looked_up(h, 12, not_finite), "perturbation"),
        (lambda h: looked_up(h, 1), "table restart"),
        (lambda h: nearest(h), "table restart"),
        (lambda h: nearest(h, 1e-3), "restart"),
    ],
    ids=["exact", "exact-nan", "rounded", "nearest", "nearest-responsive"],
)
def test_a_table_of_answers_is_found_out(
    cheat: Callable[[int | None], Answer], kind: str, horizon: int | None
):
    assert kinds(cheat(horizon), horizon) & {*kind.split()}


@pytest.mark.slow
def test_a_table_of_moments_is_found_out():
    assert "table" in kinds(nearest_moment)


class FailingLate:
    """Fails at the last request, a later start."""

    def __init__(self, reason: Reason) -> None:
        self.reason = reason
        model, held = Model(honest), fold()
        assert suspicions_of(model, held.held_out, held.scale, None) == ()
        self.left = len(model.asked)

    def __call__(self, past_u: Array, past_y: Array, u: Array) -> Array:
        self.left -= 1
        if self.left <= 0:
            raise CandidateError(self.reason)
        return honest(past_u, past_y, u)


def test_a_model_that_fails_only_from_later_starts_is_detected():
    assert kinds(FailingLate(Reason.CRASH)) == {"restart"}


@pytest.mark.parametrize("reason", [Reason.SIMULATE_TIMEOUT, Reason.MEMORY])
def test_failures_caused_by_the_machine_are_no_suspicion(reason):
    with pytest.raises(CandidateError) as caught:
        kinds(FailingLate(reason))
    assert caught.value.reason is reason


def test_answers_that_change_when_asked_again_are_found_out():
    held, scored = fold(), [True]
    table = looked_up(None, 2)
    model = Model(lambda *case: (table if scored else honest)(*case))
    y_hat = simulate_held_out(model, held.held_out)
    scored.clear()
    found = suspicions(model, held.held_out, y_hat, held.scale, None)
    assert {"replay", "strangers"} <= {one.kind.value for one in found}


@pytest.mark.parametrize("horizon", [None, 48])
def test_inputs_of_the_future_are_found_out(horizon: int | None):
    """An output is known as soon as the next input is."""
    held = fold(horizon, hold=1)
    u_known = np.stack([block.u for block in held.held_out])
    y_known = np.stack([block.y for block in held.held_out])

    def ahead(past_u: Array, past_y: Array, u: Array) -> Array:
        y = honest(past_u, past_y, u)
        for row, inputs in zip(y, u, strict=True):
            for outputs, given in zip(y_known, u_known, strict=True):
                count = min(len(inputs), len(given))
                told = np.append((inputs[:count] == given[:count])[1:, 0], False)
                if told[0]:
                    row[:count][told] = outputs[:count][told]
        return y

    broken = suspicions_of(Model(ahead), held.held_out, held.scale, horizon)
    assert "look-ahead" in {one.kind.value for one in broken}


def test_what_a_chunk_sends_ahead_is_not_used_by_an_adaptive_solver():
    """Adaptive solver: its step sizes depend on the end of the simulation, its errors do not."""

    def adaptive(past_u: Array, past_y: Array, u: Array) -> Array:
        given = hash(u.tobytes()) % 1000
        wild = np.random.default_rng(given).normal(size=(*u.shape[:2], 1))
        return honest(past_u, past_y, u) + 0.05 * wild

    assert "look-ahead" not in kinds(adaptive)


def test_a_simulation_drawn_to_data_after_the_block_is_detected():
    held = fold()
    after = {round(float(b.past_u[-1, 0]), 9): b.y[-1, 0] for b in held.held_out}
    length = len(held.held_out[0].y)

    def drawn(past_u: Array, past_y: Array, u: Array) -> Array:
        """The block's length reveals the end, from any start."""
        target = after.get(round(float(past_u[0, -1, 0]), 9), 0.5)
        left = np.clip(length - np.arange(u.shape[1]), 1, length)
        part = np.clip(1 - left / (0.3 * length), 0, 1)[None, :, None]
        return (1 - part) * honest(past_u, past_y, u) + part * target

    assert "block end" in kinds(drawn)


def single(past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate in single precision, with its rounding."""
    return honest(past_u, past_y.astype(np.float32), u.astype(np.float32)).astype(np.float32)


def chaotic(past_u: Array, past_y: Array, u: Array) -> Array:
    """The logistic map, pushed by the input."""
    x = 1 / (1 + np.exp(-past_y[:, -1]))
    y = np.empty((*u.shape[:2], 1))
    for k in range(u.shape[1]):
        x = 3.9 * x * (1 - x)
        y[:, k] = x + 0.01 * u[:, k]
    return y


def unstable(past_u: Array, past_y: Array, u: Array) -> Array:
    growth = np.exp(0.2 * np.arange(u.shape[1]))[None, :, None]
    return growth * past_y[:, -1:] + np.cumsum(u, axis=1)


def finite_memory(past_u: Array, past_y: Array, u: Array) -> Array:
    padded = np.concatenate([past_u, u], axis=1)
    n = past_u.shape[1]
    return np.tanh(sum(0.3 * padded[:, n - i : n - i + u.shape[1]] for i in range(4)))


def relay(past_u: Array, past_y: Array, u: Array) -> Array:
    """Jumps whenever the output crosses zero."""
    y = honest(past_u, past_y, u)
    crossed = np.diff(np.sign(y), axis=1, prepend=np.sign(y[:, :1])) != 0
    return y + 0.5 * crossed


def held(past_u: Array, past_y: Array, u: Array) -> Array:
    return np.repeat(past_y[:, -1:], u.shape[1], axis=1)


def mean(past_u: Array, past_y: Array, u: Array) -> Array:
    return np.full((*u.shape[:2], 1), 0.3)


def clipped(past_u: Array, past_y: Array, u: Array) -> Array:
    return np.clip(honest(past_u, past_y, u), -0.2, 0.2)


def rounded(past_u: Array, past_y: Array, u: Array) -> Array:
    return np.round(honest(past_u, past_y, u), 2)


def switched(past_u: Array, past_y: Array, u: Array) -> Array:
    """A tree: one of two gains, and steps besides."""
    y = honest(past_u, past_y, np.where(u > 0, 1.2, 0.8) * u)
    return y + 0.1 * (u > 0.5) - 0.1 * (u < -0.5)


def forward(past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate by convolution in the frequency domain: causal except for rounding."""
    n = 2 * u.shape[1]
    kernel = 0.9 ** np.arange(u.shape[1])
    spectrum = np.fft.rfft(u[..., 0], n) * np.fft.rfft(kernel, n)
    return np.fft.irfft(spectrum, n)[:, : u.shape[1], None].astype(np.float32)


def drifting(past_u: Array, past_y: Array, u: Array) -> Array:
    """Integrates twice, from a velocity that the past window shows with an error."""
    y, speed = np.empty((*u.shape[:2], 1)), 0.9 * (past_y[:, -1] - past_y[:, -2]) + 1e-3
    now = past_y[:, -1]
    for k in range(u.shape[1]):
        now = now + speed
        speed = speed + 1e-3 * u[:, k]
        y[:, k] = now
    return y


HONEST = [
    honest, single, chaotic, unstable, finite_memory, relay, held, mean, clipped, rounded, switched,
    forward, drifting,
]  # fmt: skip


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize("answer", HONEST)
def test_an_honest_model_is_not_suspected(answer: Answer, horizon: int | None):
    assert found(answer, horizon) == ()
    assert found(answer, horizon, records=1) == ()


def test_the_same_checks_twice_say_the_same():
    first, second = (found(looked_up(None, 12)) for _ in range(2))
    assert first == second
    assert {s.kind for s in first} >= {SuspicionKind.PERTURBATION}
    assert all(s.figure > 0 for s in first)


def test_the_checked_windows_are_unpredictable():
    held_out = fold(10)
    count = len(held_out.held_out)
    u = [held_out.held_out[k].u for k in (0, count // 2, count - 1)]
    known = looked_up(10, 12)

    def answer(past_u: Array, past_y: Array, given: Array) -> Array:
        if any(np.array_equal(given[0], one) for one in u):
            return honest(past_u, past_y, given)
        return known(past_u, past_y, given)

    y_hat = simulate_held_out(Model(answer), held_out.held_out)
    for seed in range(10):
        assert suspicions(Model(answer), held_out.held_out, y_hat, held_out.scale, 10, seed)


def test_a_model_that_does_not_answer_fails():
    model = Model(honest)
    held_out = fold()
    y_hat = [model.simulate(*(a[None] for a in (b.past_u, b.past_y, b.u)))[0]
             for b in held_out.held_out]  # fmt: skip

    def crash(past_u: Array, past_y: Array, u: Array) -> Array:
        raise CandidateError(Reason.CRASH)

    with pytest.raises(CandidateError):
        suspicions(Model(crash), held_out.held_out, y_hat, held_out.scale, None)


@pytest.mark.parametrize("horizon", HORIZONS)
def test_no_request_depends_on_a_clock(horizon: int | None, monkeypatch: pytest.MonkeyPatch):
    """A model that sleeps is asked as much as any other: here each look at a clock takes a day."""
    held = fold(horizon)
    plain, slow = Model(honest), Model(honest)
    first = suspicions_of(plain, held.held_out, held.scale, horizon)
    days = count()
    for name in ("time", "monotonic", "perf_counter", "process_time", "thread_time"):
        monkeypatch.setattr(f"time.{name}", lambda: 86400.0 * next(days))
    assert suspicions_of(slow, held.held_out, held.scale, horizon) == first == ()
    assert slow.asked == plain.asked
