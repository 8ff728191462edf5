"""Fit the winner of a finished search with parts taken back, and say what its gain is due to.

It reads training records alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from asia.candidate import source_digest
from asia.data import Array
from asia.errors import UserError
from asia.evaluation import Evaluator
from asia.ledger import Ablated, AblationFit, Chain, Experiment, LeftOut, SearchView, Store
from asia.problem.load import load_lock
from asia.scoring import Attribution, Failure, attribute, gain
from asia.search._run import LOCK, make_evaluator
from asia.search.ablation.splitting import crossed, without_change
from asia.search.final.confirmation import check_repeatable

OnFit = Callable[[AblationFit, int, int], None]

_WINNER = "the winner"
_BASELINE = "the baseline"
_MODEL = "the winner's model with the baseline's training"
_TRAINING = "the baseline's model with the winner's training"


@dataclass(frozen=True)
class Variant:
    """A candidate to be fitted for an ablation."""

    name: str
    """Description of the variant."""
    source: str
    """Its `candidate.py`."""

    @property
    def digest(self) -> str:
        """Digest of the normalised AST: equivalent variants are fitted once."""
        return source_digest(self.source)


def ablate(directory: Path, on_fit: OnFit, *, seeds: int = 3) -> tuple[Ablated, bool]:
    """Cross model and training of winner and baseline, and leave each change of the winner's
    lineage out; True where the ledger had no such result yet.

    Each fit is an event of the ledger: one that is there is not repeated, whether the command was
    killed or asks for more seeds now. on_fit: called after each fit with its event, the number of
    fits that are done, and that of all there may be.

    Raises UserError when the search is not finished, is with ladder feedback, its winner is its
    baseline, or it came without its artifacts.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        check_repeatable(directory, view, "an ablation")
        winner = view.best
        assert winner is not None
        if winner.number == 1:
            raise UserError(
                f"the winner of run '{view.started.run}' is its baseline: there is no gain to "
                "attribute"
            )
        problem = load_lock(directory / LOCK)
        evaluator = make_evaluator(problem, view)
        store = Store(directory / "artifacts")
        found = _Ablation(chain, store, evaluator, seeds, on_fit).run(winner)
        if view.ablated == found:
            return found, False
        chain.append(found)
        return found, True


def lineage(view: SearchView, winner: Experiment) -> list[Experiment]:
    """The winner and what it was made from, the oldest first."""
    found = [winner]
    while (parent := found[-1].proposed.parent) is not None and parent < found[-1].number:
        found.append(view.experiment(parent))
    return found[::-1]


@dataclass(frozen=True)
class _Ablation:
    """An ablation under way."""

    chain: Chain
    store: Store
    evaluator: Evaluator
    seeds: int
    on_fit: OnFit

    def run(self, winner: Experiment) -> Ablated:
        """Fit all variants and summarise them."""
        view = self.chain.view
        baseline = view.experiment(1)
        cross, reason = self._crossing(winner, baseline)
        changes = self._changes(winner)
        variants = {_WINNER: Variant(_WINNER, self._source(winner)), **cross}
        variants |= {v.name: v for v in changes.values() if isinstance(v, Variant)}
        values = self._fit_all(list(variants.values()))
        found: Attribution | None = None
        if cross:
            names = (_BASELINE, _MODEL, _TRAINING, _WINNER)
            failed = [name for name in names if not len(values[name])]
            if failed:
                reason = f"{failed[0]} fails with every seed"
            else:
                found = attribute(*(values[name] for name in names))
        left_out = tuple(
            _left_out(number, made, values) for number, made in sorted(changes.items())
        )
        return Ablated(winner.number, baseline.number, self.seeds, found, reason, left_out)

    def _crossing(self, winner: Experiment, baseline: Experiment) -> tuple[dict[str, Variant], str]:
        """The other three of the four, or why there are none."""
        best, first = self._source(winner), self._source(baseline)
        if baseline.score is None:
            return {}, "the baseline has no score"
        try:
            sources = (first, crossed(best, first), crossed(first, best))
            variants = map(Variant, (_BASELINE, _MODEL, _TRAINING), sources)
            return {variant.name: variant for variant in variants}, ""
        except UserError as error:
            return {}, str(error)

    def _changes(self, winner: Experiment) -> dict[int, Variant | str]:
        """Return for each change of the lineage the winner without it, or the reason why there is
        none.
        """
        line, found = lineage(self.chain.view, winner), dict[int, Variant | str]()
        for before, after in pairwise(line):
            number = after.number
            try:
                source = without_change(*map(self._source, (winner, before, after)))
            except UserError as error:
                found[number] = str(error)
                continue
            name = f"the winner without the change of #{number:02d}"
            found[number] = Variant(name, source) if source else "no part of it is left"
        return found

    def _source(self, experiment: Experiment) -> str:
        return self.store.text(experiment.proposed.source)

    def _fit_all(self, variants: list[Variant]) -> dict[str, Array]:
        """V of each over the seeds, a single value where fits do not depend on them."""
        different = {variant.digest: variant for variant in variants}
        total, done = len(different) * self.seeds, 0
        with self.evaluator.ready_workers():
            for digest, variant in different.items():
                for repeat in range(1, self.seeds + 1):
                    done += 1
                    if self._known(digest, repeat) is None:
                        event = self._fit(variant, repeat)
                        self.chain.append(event)
                        self.on_fit(event, done, total)
                    if self._is_same(digest, repeat):
                        done += self.seeds - repeat
                        break
        return {variant.name: self._values(variant.digest) for variant in variants}

    def _known(self, digest: str, repeat: int) -> AblationFit | None:
        for fit in self.chain.view.ablation_fits:
            if (fit.digest, fit.repeat) == (digest, repeat):
                return fit
        return None

    def _fit(self, variant: Variant, repeat: int) -> AblationFit:
        begin = time.monotonic()
        outcome = self.evaluator.evaluate(variant.source, repeat).outcome
        seconds = time.monotonic() - begin
        source = self.store.put(variant.source.encode())
        identity = variant.name, source, variant.digest, repeat
        if isinstance(outcome, Failure):
            return AblationFit(*identity, failed=outcome.reason.value, seconds=seconds)
        folds = tuple(fold.value for fold in outcome.folds)
        return AblationFit(*identity, outcome.value, folds, seconds=seconds)

    def _is_same(self, digest: str, repeat: int) -> bool:
        """Return whether all folds have the same V as with the seed before, or as in the search, so
        that the seed has no effect.
        """
        last = self._known(digest, repeat)
        assert last is not None
        before = self._known(digest, repeat - 1)
        if before is not None:
            return bool(last.folds) and last.folds == before.folds
        twins = (e for e in self.chain.view.finished if e.proposed.digest == digest and e.score)
        return any(last.folds == tuple(f.value for f in e.score.folds) for e in twins if e.score)

    def _values(self, digest: str) -> Array:
        fits = [self._known(digest, repeat) for repeat in range(1, self.seeds + 1)]
        found = [fit for fit in fits if fit is not None and fit.value is not None]
        alike = len({fit.folds for fit in found}) == 1
        return np.array([fit.value for fit in found[: 1 if alike else None]])


def _left_out(number: int, made: Variant | str, values: dict[str, Array]) -> LeftOut:
    if isinstance(made, str):
        return LeftOut(number, detail=made)
    if not len(values[made.name]) or not len(values[_WINNER]):
        return LeftOut(number, detail="it fails with every seed")
    return LeftOut(number, gain(values[made.name], values[_WINNER]))
