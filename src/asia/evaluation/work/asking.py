"""Where the search has a fold fitted: a message to a sandbox here, or to another machine."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from asia._stopwatch import Stopwatch
from asia.candidate import Context
from asia.errors import UserError
from asia.evaluation._oracle import Oracle
from asia.evaluation._results import derive_seed
from asia.evaluation.work.elsewhere import answer
from asia.evaluation.work.fit import OpenWorker, fit_fold
from asia.evaluation.work.installation import installation_for
from asia.evaluation.work.message import (
    FoldAnswer,
    FoldData,
    FoldWork,
    decode_answer,
    decode_work,
    encode_data,
    encode_work,
    fold_data,
    local_answer,
)
from asia.evaluation.work.stopping import FitStop
from asia.executor import Carrier
from asia.protocol import Fold, ProtocolRule, whole
from asia.sandbox import Isolation, Limits, layers_in_force


class FoldAsker:
    """Sends folds of one search, and takes the answers."""

    def __init__(
        self,
        rule: ProtocolRule,
        context: Context,
        isolation: Isolation,
        carrier: Carrier | None,
        problem: str,
        alone: bool,
    ) -> None:
        """context: what is the same for all folds; carrier: None where folds are fitted here;
        problem: sha256 of the run's lock file; alone: whether no two workers may run at once.
        Raises UserError where candidates may ask for their score, which takes the held-out outputs
        to the machine that fits."""
        if carrier is not None and rule.early_stopping != "inner":
            raise UserError(
                "validation early stopping needs the held-out outputs where a candidate is fitted, "
                "and other machines do not get them: use --executor local"
            )
        self._rule, self._context = rule, context
        self._isolation, self._carrier, self._problem = isolation, carrier, problem
        self._alone = alone
        self._data: dict[int, tuple[FoldData, str, bytes]] = {}

    def ask(
        self,
        source: str,
        fold: Fold,
        start: int,
        open_worker: OpenWorker,
        oracle: Oracle | None,
        watch: Stopwatch,
        stop: FitStop,
        limits: Limits,
    ) -> FoldAnswer:
        """What comes of `source` on a fold; start: another one has another seed; stop: ends it
        elsewhere too; limits: of its worker. Raises SandboxError, and UserError where a machine is
        not fit for the work."""
        data, digest, raw = self._data_of(fold)
        work = FoldWork(
            problem=self._problem,
            data=digest,
            fold=fold.index + 1,
            source=source,
            context=replace(self._context, seed=derive_seed(self._context.seed, fold.index, start)),
            limits=limits,
            isolation=self._isolation,
            layers=tuple(layer.value for layer in layers_in_force(self._isolation)),
            alone=self._alone,
        )
        train = [(b.y.shape[0], b.y.shape[1]) for b in whole(fold.train, self._rule)]
        if self._carrier is None:
            request = encode_work(work, {})
            fitted = fit_fold(decode_work(request), data, open_worker, oracle)
            return local_answer(fitted, data, train)
        request = encode_work(work, installation_for(limits))
        with stop.ending(partial(self._carrier.forget, request)):
            reply = self._carrier.carry(answer, request, digest, raw)
        found = decode_answer(reply, data, train)
        for activity, (wall, processor) in found.spent.items():
            watch.add(activity, wall, processor)
        return found

    def _data_of(self, fold: Fold) -> tuple[FoldData, str, bytes]:
        """The data of a fold, with digest and bytes where they are sent."""
        if fold.index not in self._data:
            data = fold_data(fold, self._rule)
            digest, raw = ("", b"") if self._carrier is None else encode_data(data)
            self._data[fold.index] = data, digest, raw
        return self._data[fold.index]
