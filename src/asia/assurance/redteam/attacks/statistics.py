"""Candidates that infer the held-out outputs from how their training records are standardised:
records that have mean 0 and mean square 1 as a whole tell in one part what the other part lacks."""

from __future__ import annotations

from asia.assurance.redteam.attacks.source import candidate
from asia.assurance.redteam.evidence import scores_better
from asia.assurance.redteam.problem import Principle
from asia.assurance.redteam.types import Barrier, CandidateAttack

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
