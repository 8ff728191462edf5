"""Description length: data in the source of a new best against the information that it gained.

A record that is copied into a source with b bits lowers the held-out error by b bits of
log-likelihood at most (rate-distortion theory), while a constant of an honest model is worth more
than it takes to write. So a new best whose literals take more than a tenth of its gain must pass
two questions that a copy fails: does it also gain on records that nobody was shown, and does it
keep its gain where its literals change in their last digits?
"""

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import inf
from pathlib import Path

import asia
from asia._syntax import syntax_tree
from asia.candidate import executed_source
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.results import FoldResult, mean_simulation
from asia.judge.scoring.description import LiteralCheck, gained_bits, guard_gap
from asia.judge.scoring.outcome import Failure, Score, combine, score_fold
from asia.literals import Literals, equations_as_code, literals, merged, perturbed
from asia.problem.folds import Block

COLLAPSE = 0.5
"""Bits by which the error of a fold grows where literals decide it: a factor of 1.41."""
SCATTER = 1.0
"""Bits by which log2 of the error on the guard records over V may scatter among honest bests before
the perturbation is asked: 1.14 at most between two of them, measured on 154 guard samples."""
CONFIRMED, CONTRADICTED = 0.25, 1.0
"""Bits by which V may fall more than the error on the guard records: up to the first the guard
confirms the gain, beyond the second it contradicts it."""
UNGUARDED = 4096.0
"""Bits of literals that are refused without guard records: nearly twice what honest hand-written
candidates hold (2.3 kbit)."""
_LARGEST_RATIO = 1e6


@dataclass(frozen=True)
class Standard:
    """The first best of a search, which all later ones are compared with."""

    experiment: int
    source: str
    score: Score
    y_hats: Sequence[Sequence[Array]]
    """Its simulations (H, ny) of the held-out blocks of each fold."""


@dataclass(frozen=True)
class Guard:
    """Records that no agent was shown."""

    blocks: tuple[Block, ...]
    least_gap: float
    """log2 of the error on them over V that honest models have: that of the first best, or, where
    it is lower, the lowest of the bests before plus SCATTER."""


def literals_of(source: str) -> Literals:
    """Return the literals of a candidate's source. Raises CandidateError for one that cannot be a
    candidate."""
    text = executed_source(source)
    tree = syntax_tree(text, "candidate.py")
    declared = equations_as_code(tree)
    if declared is not tree:
        text = ast.unparse(declared)
        tree = syntax_tree(text, "candidate.py")
    return literals(text, tree)


@cache
def library_literals() -> Literals:
    """Literals of the model library, its defaults included: each is known once."""
    root = Path(asia.__file__).parent / "models"
    texts = [path.read_text("utf-8") for path in sorted(root.rglob("*.py"))]
    return merged(literals(text, ast.parse(text)) for text in texts)


def guard_error(
    evaluator: Evaluator, source: str, models: Sequence[bytes], blocks: Sequence[Block]
) -> Score | Failure:
    """Score the mean simulation of fold models on the guard records, in the search's metric over
    the standard deviations of all training records."""
    try:
        y_hat = mean_simulation(
            evaluator.models.simulate_scored([(source, m) for m in models], blocks)
        )
        y, data = [block.y for block in blocks], evaluator.data
        return combine([score_fold(y, y_hat, data.scale, data.rule.metric)])
    except CandidateError as error:
        return Failure(error.reason, error.detail)


def check_literals(
    evaluator: Evaluator,
    source: str,
    score: Score,
    folds: Sequence[FoldResult],
    standard: Standard,
    guard: Callable[[], Guard | None],
    *,
    doubted: bool = False,
) -> LiteralCheck:
    """Compare the literals of a new best with its gain; where they take more than a tenth of it,
    ask the guard records and a refit with perturbed literals.

    Args:
        score: its score
        folds: its results, one a fold
        standard: first best of the search
        guard: asked only where it decides, since it simulates; None where the problem has no
            guard records
        doubted: ask whatever the literals take
    """
    own, known = literals_of(source), literals_of(standard.source)
    bits = own.bits_beyond(known, library_literals())
    y = [[block.y for block in fold.held_out] for fold in evaluator.data.folds]
    gain = gained_bits(y, standard.y_hats, [fold.y_hat for fold in folds])
    found = LiteralCheck(standard.experiment, bits, gain)
    if SuspicionKind.LITERALS in evaluator.without or (found.affordable and not doubted):
        return found
    # Agents read this: it has no figure of held-out data.
    whole = f", its whole text included because `{own.reader}` can read it," if own.text else ""
    spent = (
        f"literals: the source holds {bits:.0f} bits of data{whole} more than "
        f"#{standard.experiment:02d} and the library, above a tenth of what V gained"
    )
    beyond, known_guard = inf, guard()
    if known_guard is not None:
        models = [fold.model for fold in folds]
        outcome = guard_error(evaluator, source, models, known_guard.blocks)
        if isinstance(outcome, Failure):
            words = f"{spent}, and it has no score on the guard records ({outcome.reason.value})"
            return replace(found, suspect=words)
        found = replace(found, guard=outcome.value)
        beyond = guard_gap(outcome.value, score.value) - known_guard.least_gap
        if beyond <= CONFIRMED:
            return found
        if beyond > CONTRADICTED:
            words = f"{spent}, and the guard records, which nobody was shown, do not confirm it"
            return replace(found, suspect=words)
    elif bits > UNGUARDED:
        return replace(found, suspect=f"{spent}, and there are no guard records to judge it by")
    ratio = _perturbed_ratio(evaluator, source, known, folds)
    found = replace(found, perturbed=None if ratio is None else min(ratio, _LARGEST_RATIO))
    words = ""
    if ratio is not None and ratio > 2**COLLAPSE:
        words = f"{spent}, and refitted with them changed in their last digits it loses the gain"
    return replace(found, suspect=words)


def _perturbed_ratio(
    evaluator: Evaluator, source: str, known: Literals, folds: Sequence[FoldResult]
) -> float | None:
    """Error of one fold, refitted from the perturbed source, over its error before. None where
    there is nothing to perturb, or the perturbed program fails even with its strings as they were:
    then it is another program."""
    seed = evaluator.models.check_seed(source, "literals")
    place, text = seed % len(folds), executed_source(source)
    for strings in (True, False):
        moved = perturbed(syntax_tree(text, "candidate.py"), known, seed, strings=strings)
        if moved is None:
            return None
        result = evaluator.fit_fold(moved, place)
        if isinstance(result, FoldResult):
            before = folds[place].score.value
            return result.score.value / before if before > 0 else inf
        if result.reason is Reason.NOT_FINITE:
            return inf
    return None
