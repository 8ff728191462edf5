"""Cheats that isolation cannot stop give themselves away; honest models never."""

from collections.abc import Callable

import numpy as np
import pytest

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation import relations
from asia.judge.evaluation.relations import SuspicionKind, suspicions
from asia.judge.evaluation.requests import held_out_requests, simulate_held_out
from tests.unit.judge.evaluation.relations import Answer, Model, fold, found, honest, suspicions_of

HORIZONS = [None, 20]


@pytest.fixture(autouse=True)
def only_lengths_that_are_always_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fix the lengths of prefixes; the number of further ones depends on the time."""
    monkeypatch.setattr(relations, "_MORE", 0)


def kinds(answer: Answer, horizon: int | None = None, records: int = 3) -> set[str]:
    return {suspicion.kind.value for suspicion in found(answer, horizon, records)}


def answers(horizon: int | None) -> tuple[Array, Array]:
    """Inputs and outputs of every held-out case, as one who has seen all records knows them."""
    blocks = fold(horizon).held_out
    return np.stack([b.case.u for b in blocks]), np.stack([b.y for b in blocks])


def looked_up(horizon: int | None, digits: int, otherwise: Answer = honest) -> Answer:
    u_known, y_known = answers(horizon)
    table = {np.round(u, digits).tobytes(): y for u, y in zip(u_known, y_known, strict=True)}

    def answer(past_u: Array, past_y: Array, u: Array) -> Array:
        y = otherwise(past_u, past_y, u)
        return np.stack(
            [table.get(np.round(row, digits).tobytes(), own) for row, own in zip(u, y, strict=True)]
        )

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


class Counting:
    """The first answer is read off; the second one is its own."""

    def __init__(self, horizon: int | None) -> None:
        self.table, self.calls = looked_up(horizon, 2), 0

    def __call__(self, past_u: Array, past_y: Array, u: Array) -> Array:
        self.calls += 1
        return (self.table if self.calls <= 3 else honest)(past_u, past_y, u)


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize(
    ("cheat", "kind"),
    [
        (lambda h: looked_up(h, 12), "perturbation"),
        (lambda h: looked_up(h, 12, not_finite), "perturbation"),
        (lambda h: looked_up(h, 1), "restart"),
        (lambda h: nearest(h), "table"),
        (lambda h: nearest(h), "restart"),
        (lambda h: nearest(h, 1e-3), "restart"),
    ],
    ids=["exact", "exact-nan", "rounded", "nearest", "nearest-shifted", "nearest-responsive"],
)
def test_a_table_of_answers_is_found_out(
    cheat: Callable[[int | None], Answer], kind: str, horizon: int | None
):
    assert kind in kinds(cheat(horizon), horizon)


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
    assert "replay" in kinds(Counting(None))


@pytest.mark.parametrize("horizon", HORIZONS)
def test_inputs_of_the_future_are_found_out(horizon: int | None):
    def ahead(past_u: Array, past_y: Array, u: Array) -> Array:
        return honest(past_u, past_y, np.roll(u, -2, axis=1))

    assert "causality" in kinds(ahead, horizon)


@pytest.mark.slow
def test_a_look_ahead_at_few_places_takes_more_lengths(monkeypatch: pytest.MonkeyPatch):
    """Every tenth sample: three lengths miss it, more of them do not."""

    def ahead(past_u: Array, past_y: Array, u: Array) -> Array:
        y = honest(past_u, past_y, u)
        y[:, :-1:10] = honest(past_u, past_y, np.roll(u, -1, axis=1))[:, :-1:10]
        return y

    held = fold(None)
    y_hat = simulate_held_out(Model(ahead), held.held_out, None)

    def flagged(seed: int) -> bool:
        found = suspicions(Model(ahead), held.held_out, y_hat, held.scale, None, seed)
        return "causality" in {one.kind.value for one in found}

    few = sum(flagged(seed) for seed in range(20))
    monkeypatch.setattr(relations, "_MORE", 60)
    monkeypatch.setattr(relations, "_COMPILES", np.inf)
    monkeypatch.setattr(relations, "_MORE_SECONDS", np.inf)
    assert few < 15
    assert sum(flagged(seed) for seed in range(20)) >= 19


def test_the_only_window_of_each_record_has_its_own_request():
    def mixed(past_u: Array, past_y: Array, u: Array) -> Array:
        return honest(past_u, past_y, u) + 0.1 * past_y[:, -1:].mean(axis=0)

    assert "strangers" in kinds(mixed, 112)


def test_windows_of_a_record_stand_in_no_row_of_their_own():
    requests = held_out_requests(fold(10).held_out, 10)
    records = [block.record for block in fold(10).held_out]
    orders = {tuple(records[i] for i in request) for request in requests}
    assert len(orders) > 3
    assert requests == held_out_requests(fold(10).held_out, 10)


def test_a_short_window_has_prefixes():
    def ahead(past_u: Array, past_y: Array, u: Array) -> Array:
        return honest(past_u, past_y, np.roll(u, -1, axis=1))

    assert kinds(ahead, 4) == {"causality"}


def test_wild_first_samples_excuse_no_later_ones():
    def wild(past_u: Array, past_y: Array, u: Array) -> Array:
        y = honest(past_u, past_y, np.roll(u, -1, axis=1))
        y[:, :3, 0] += 0.8 * np.sign(np.sin(1e8 * (u[:, :3, 0] + past_y[:, -1:, 0])))
        return y

    assert "causality" in kinds(wild)


def test_a_simulation_drawn_to_data_after_the_block_is_detected():
    held = fold()
    after = {round(float(b.case.past_u[-1, 0]), 9): b.y[-1, 0] for b in held.held_out}
    length = len(held.held_out[0].y)

    def drawn(past_u: Array, past_y: Array, u: Array) -> Array:
        """The block's length reveals the end, from any start."""
        target = after.get(round(float(past_u[0, -1, 0]), 9), 0.5)
        left = np.clip(length - np.arange(u.shape[1]), 1, length)
        part = np.clip(1 - left / (0.3 * length), 0, 1)[None, :, None]
        return (1 - part) * honest(past_u, past_y, u) + part * target

    assert "block end" in kinds(drawn)


def test_cases_that_know_their_neighbours_are_found_out():
    def mixed(past_u: Array, past_y: Array, u: Array) -> Array:
        return honest(past_u, past_y, u) + 0.1 * past_y[:1, -1:]

    assert "strangers" in kinds(mixed, 20)
    assert "strangers" not in kinds(mixed, None)


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


@pytest.mark.parametrize("horizon", HORIZONS)
def test_requests_are_few_and_in_few_shapes(horizon: int | None):
    held_out, model = fold(horizon), Model(honest)
    suspicions_of(model, held_out.held_out, held_out.scale, horizon)
    scored = len(held_out.held_out) if horizon is None else -(-len(held_out.held_out) // 3)
    least, whole = min(shape[1] for shape in model.asked), held_out.held_out[0].case.u.shape[0]
    assert least < 0.25 * whole
    assert max(model.asked)[1] == whole
    assert len(model.asked) <= 2 * scored + 24 + 6 * 11


def test_the_same_checks_twice_say_the_same():
    first, second = (found(looked_up(None, 12)) for _ in range(2))
    assert first == second
    assert {s.kind for s in first} >= {SuspicionKind.PERTURBATION}
    assert all(s.figure > 0 for s in first)


def test_the_checked_windows_are_unpredictable():
    held_out = fold(10)
    requests = held_out_requests(held_out.held_out, 10)
    assert len(requests) > 9
    spared = {0, len(requests) // 2, len(requests) - 1}
    u = [held_out.held_out[i].case.u for k in spared for i in requests[k]]
    known = looked_up(10, 12)

    def answer(past_u: Array, past_y: Array, given: Array) -> Array:
        if any(np.array_equal(given[0], one) for one in u):
            return honest(past_u, past_y, given)
        return known(past_u, past_y, given)

    y_hat = simulate_held_out(Model(answer), held_out.held_out, 10)
    for seed in range(10):
        assert suspicions(Model(answer), held_out.held_out, y_hat, held_out.scale, 10, seed)


def test_a_model_that_does_not_answer_fails():
    model = Model(honest)
    held_out = fold()
    y_hat = [model.simulate(*(a[None] for a in (b.case.past_u, b.case.past_y, b.case.u)))[0]
             for b in held_out.held_out]  # fmt: skip

    def crash(past_u: Array, past_y: Array, u: Array) -> Array:
        raise CandidateError(Reason.CRASH)

    with pytest.raises(CandidateError):
        suspicions(Model(crash), held_out.held_out, y_hat, held_out.scale, None)
