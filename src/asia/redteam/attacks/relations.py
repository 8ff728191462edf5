"""Attacks by outputs that depend on forbidden data: later inputs, other windows, the data after a
held-out block."""

from __future__ import annotations

from asia.evaluation import SuspicionKind
from asia.redteam._types import Barrier, CandidateAttack
from asia.redteam.attacks.foresight import FORESIGHT
from asia.redteam.attacks.holes import HOLES
from asia.redteam.attacks.rows import MEMORY, PLACES, ROWS
from asia.redteam.evidence.signs_of_success import scores_better

_ALL_ASKED = (
    SuspicionKind.CAUSALITY,
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
        checks=_ALL_ASKED,
    ),
    CandidateAttack(
        38,
        "average over the rows",
        "learns of a disturbance by the mean, the median or the signs of all rows of a request, "
        "from the start or late in the row",
        ROWS,
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="weather",
        checks=(SuspicionKind.STRANGERS, SuspicionKind.BLOCK_END),
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
        (Barrier.METAMORPHIC,),
        problem="drift",
        checks=(SuspicionKind.BLOCK_END, SuspicionKind.CAUSALITY),
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
        ROWS,
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="pulses",
        checks=_ALL_ASKED,
    ),
    CandidateAttack(
        45,
        "look ahead in short windows",
        "reads a feedback signal ahead in windows of a few samples",
        {name: FORESIGHT[name] for name in ("but at the splice", "at the beginning")},
        scores_better,
        (Barrier.METAMORPHIC,),
        problem="windows",
        checks=_ALL_ASKED,
    ),
)
