"""The work itself: fit a candidate on a fold in a sandbox, and simulate. Nothing is scored here."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from asia._stopwatch import Activity
from asia.candidate import imported_libraries
from asia.errors import CandidateError
from asia.evaluation._findings import Fitted
from asia.evaluation._oracle import Oracle
from asia.evaluation._requests import largest, simulate_requests, simulate_training
from asia.evaluation.work.message import FoldAnswer, FoldData, FoldWork
from asia.protocol import whole
from asia.sandbox import FitReply, Limits, Worker

OpenWorker = Callable[[frozenset[str], Limits], AbstractContextManager[Worker]]


def fit_fold(
    work: FoldWork, data: FoldData, open_worker: OpenWorker, oracle: Oracle | None = None
) -> FoldAnswer:
    """Fit and simulate in one worker, which names its parameters before it knows a case.

    oracle: scores the model on the held-out part during the fit, where the protocol allows it; it
    has the held-out outputs, so it is there on the search's own machine alone. Raises SandboxError
    for what is not the candidate's fault.
    """
    printed: list[str] = []
    try:
        fitted = _fitted(work, data, open_worker, oracle, printed)
    except CandidateError as error:
        return FoldAnswer(error, "".join(printed))
    return FoldAnswer(fitted, "".join(printed))


def _fitted(
    work: FoldWork,
    data: FoldData,
    open_worker: OpenWorker,
    oracle: Oracle | None,
    printed: list[str],
) -> Fitted:
    inside, horizon = whole(data.train, data.rule), data.rule.horizon
    with open_worker(imported_libraries(work.source, fitting=True), work.limits) as worker:
        try:
            reply = _fit(worker, work, data, oracle)
        finally:
            printed.append(worker.printed)
        device = worker.device() if work.limits.gpu else ""
        parameters, model = worker.parameters(), worker.dump()
        found = simulate_requests(worker, data.blocks, data.requests, largest(data.requests))
        y_hat = tuple(found[i] for i in range(len(data.cases)))
        train_y_hat = simulate_training(worker, inside, horizon)
        memory = worker.peak_memory_mb
    seconds = [worker.spent.get(a, (0.0, 0.0))[0] for a in (Activity.TRACE, Activity.COMPILE)]
    return Fitted(reply, model, parameters, y_hat, train_y_hat, memory, sum(seconds), device)


def _fit(worker: Worker, work: FoldWork, data: FoldData, oracle: Oracle | None) -> FitReply:
    context = replace(work.context, deadline=time.monotonic() + work.limits.fit_seconds)
    if oracle is None:
        return worker.fit(work.source, data.train, context)
    with oracle:
        return worker.fit(work.source, data.train, context, oracle)
