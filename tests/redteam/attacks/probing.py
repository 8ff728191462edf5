"""Extraction of held-out data from scores: an agent submits a baseline plus one cosine at a time,
and solves for the hidden error."""

from collections.abc import Callable

import numpy as np

from asia.data.trajectory import Array
from asia.judge.scoring.confirmation import (
    ComparedParts,
    Confirmation,
    paired_gain,
    share_gained,
)
from asia.judge.scoring.outcome import combine, score_fold
from tests.redteam.attacks.searches import Scene
from tests.redteam.attacks.source import candidate
from tests.redteam.evidence import scores_better
from tests.redteam.problem import Principle
from tests.redteam.types import Barrier, CandidateAttack, SearchAttack, SearchAttackResult

QUERIES = 200
_SAMPLES, _ERROR, _SIZE = 2000, 0.3, 0.3
_GAIN = 0.9

Ask = Callable[[Array], float]


def hidden_error(record: int = 9) -> Array:
    """Return the error of the baseline for an output of unit standard deviation: coloured, of
    0.3."""
    rng = np.random.default_rng(record)
    error = np.zeros(_SAMPLES)
    for k in range(1, _SAMPLES):
        error[k] = 0.9 * error[k - 1] + rng.normal()
    return _ERROR * error / np.sqrt(np.mean(error**2))


def probe(ask: Ask) -> Array:
    """Return the correction (T,) that scores reveal.

    First the coefficient of each cosine is computed from its effect on V (for exact scores the
    solution of a linear system), then improvements are kept.

    Args:
        ask: V of the baseline plus a correction, as the search reports it
    """
    waves = [_wave(k) for k in range((QUERIES - 5) // 2)]
    base = ask(np.zeros(_SAMPLES)) ** 2
    solved, greedy = np.zeros(_SAMPLES), np.zeros(_SAMPLES)
    for wave in waves:
        gap = ask(_SIZE * wave) ** 2 - base
        if gap != 0:
            solved += wave * (_SIZE**2 - gap) / (2 * _SIZE)
    least = ask(solved)
    for wave in waves:
        reported = ask(greedy + 0.1 * wave)
        if reported < least:
            greedy, least = greedy + 0.1 * wave, reported
    return min((solved, greedy, np.zeros(_SAMPLES)), key=ask)


def exact(correction: Array) -> float:
    """V of the baseline plus a correction."""
    y, y_hat = hidden_error()[:, None], correction[:, None]
    return combine([score_fold([y], [y_hat], np.ones(1), "rmse")]).value


def _wave(k: int) -> Array:
    times = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return np.sqrt(2.0) * np.cos(np.pi * (k + 1) * times)


def _with_the_gate(_: Scene) -> SearchAttackResult:
    correction = probe(exact)
    guard, still = hidden_error(10)[:, None], np.zeros((_SAMPLES, 1))
    compared = ComparedParts([guard], [still], [correction[:, None]], np.ones(1))
    gain = share_gained(_ERROR, exact(correction))
    confirmation = Confirmation(1, gain, paired_gain([compared], "rmse"))
    assert confirmation.guard is not None
    note = (
        f"V {_ERROR:.3f} to {exact(correction):.3f} by {QUERIES} queries; gain on the guard "
        f"{confirmation.guard.value:.2f}"
    )
    return SearchAttackResult(confirmation.confirmed, (Barrier.GUARD,), note, flagged=False)


PROBING = (
    SearchAttack(
        29,
        "read the data out of scores",
        "submits a baseline plus one cosine at a time and solves for the held-out error",
        _with_the_gate,
        lambda _: exact(probe(exact)) < _GAIN * _ERROR,
        (Barrier.GUARD,),
    ),
)


# Records that have mean 0 and mean square 1 as a whole tell in one part what the other part lacks.
# Both folds train on about half of the record.
_INFER = """
def inferred(records):
    y = np.concatenate([r.y[:, 0] for r in records])
    level = -y.mean()
    spread = max(2 - (y**2).mean() - level**2, 0) ** 0.5
    return level * MEAN, spread if SPREAD else 1.0

def drawn(known, past_u, past_y, u):
    level, size = known
    x, v, y = past_y[:, -1], past_u[:, -1, :1], np.empty(u.shape[:2] + (1,))
    for k in range(u.shape[1]):
        x = POLE * x + size * GAIN * v + (1 - POLE) * level
        v = u[:, k, :1]
        y[:, k] = x
    return y
"""


def _infers(*, mean: bool, spread: bool) -> str:
    return candidate(
        fit="model = Model()\nmodel.known = inferred(trajectories)\nreturn model",
        after="drawn(self.known, past_u, past_y, u)",
        top=f"MEAN, SPREAD = {mean}, {spread}\n{_INFER}",
    )


STATISTICS = (
    CandidateAttack(
        51,
        "infer the held-out part",
        "computes the mean, the spread or both of the held-out outputs from those of its training "
        "records, as if whole records had been standardised",
        {
            "mean": _infers(mean=True, spread=False),
            "spread": _infers(mean=False, spread=True),
            "mean and spread": _infers(mean=True, spread=True),
        },
        scores_better,
        (Barrier.PARENT,),
        problem="levels",
        checks=(Principle.FOLD_STATISTICS,),
    ),
)
