"""Search whose candidates are nothing but scores.

The rules of real searches decide which candidates are checked, kept and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from asia.errors import Reason
from asia.evaluation import Evaluation, Evaluator, FoldResult
from asia.ledger import Evaluated, Event, Proposed, Started, published, replay
from asia.scoring import Failure, Score
from asia.search.deciding.judging import judge

HALVINGS = 15

Spoil = Callable[[Score], Failure | None]


class ScoreOnlySearch:
    """A search with a Ladder of this step, or none."""

    def __init__(self, ladder: float | None) -> None:
        self._events: list[Event] = [_started(ladder)]

    def submit(self, score: Score, spoil: Spoil | None = None) -> Evaluated:
        """Submit a score and return the result that an agent would see.

        Args:
            spoil: the way in which the candidate breaks a relation
        """
        view, evaluator = replay(self._events), _Known(score, spoil)
        number, judged = len(view.experiments) + 1, judge(evaluator, "", view)
        name, status, outcome = str(number), judged.status, judged.evaluation.outcome
        proposed = Proposed(number, None, "explore", "probe", name, "h", "e", name, name)
        self._events += [proposed, Evaluated(number, status, outcome, (), None, 0.0)]
        result = published(replay(self._events)).experiment(number).result
        assert result is not None
        return result


def turn(doubt: Callable[[float], bool], most: float) -> float:
    """Find the threshold of a verdict by bisection: the largest share in [0, most] that is
    refused."""
    low, high = 0.0, most
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if doubt(middle) else (low, middle)
    return low


def forgetful(score: Score) -> Failure | None:
    """Return the failure of a model whose outputs differ when a case is repeated, at any score."""
    del score
    return Failure(Reason.SUSPECT, "replay: the same case simulated again gives another output", 1)


def one_start(bound: float) -> Spoil:
    """Return the failure of a model that is so bad from later starts that the check fails if its
    own V is below `bound`."""
    words = "restart: the simulation is far worse from a later start on the same record"
    failure = Failure(Reason.RESTART, words, 1)
    return lambda score: failure if score.value < bound else None


class _Known(Evaluator):
    """Gives a known score, and a known objection, without a worker."""

    def __init__(self, score: Score, spoil: Spoil | None = None) -> None:
        self._known, self._spoil = score, spoil

    def evaluate(self, source: str, start: int = 0) -> Evaluation:
        """The score, from whatever start."""
        del start
        return Evaluation(self._known)

    def objection(self, source: str, folds: Sequence[FoldResult]) -> Failure | None:
        """Return the objection that the candidate asks for."""
        return None if self._spoil is None else self._spoil(self._known)


def _started(ladder: float | None) -> Started:
    digest = "0" * 64
    return Started(
        run="probe",
        problem="probe",
        agent="probe",
        seed=0,
        experiments=1000,
        hours=None,
        outputs=("y",),
        lock_digest=digest,
        protocol_digest=digest,
        test_digest=None,
        isolation="process",
        isolation_notes=(),
        environment={},
        ladder=ladder,
    )
