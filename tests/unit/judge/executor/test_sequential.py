"""--isolation-strict: no two workers of a candidate at once, and the ledger says so."""

from collections.abc import Callable
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.judge.evaluation import workers as workers_module
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.search.run import Prepared, prepare, search
from tests.unit.search.toy import Scripted, arx, write_problem


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of open workers at each start of a worker."""
    there: set[Worker] = set()
    found: list[int] = []

    def counted(level: Isolation, limits: Limits, **options: object) -> Worker:
        worker = open_worker(level, limits, **options)  # type: ignore[arg-type]
        there.add(worker)
        close: Callable[[], None] = worker.close

        def closed() -> None:
            close()
            there.discard(worker)

        monkeypatch.setattr(worker, "close", closed)
        found.append(len(there))
        return worker

    monkeypatch.setattr(workers_module, "open_worker", counted)
    monkeypatch.setattr("asia.judge.sandbox.standby.open_worker", counted)
    return found


def prepared(root: Path, *, strict: bool) -> Prepared:
    problem = root / "toy"
    if not problem.is_dir():
        write_problem(problem, experiments=2)
    return prepare(
        load_problem(problem), "scripted", seed=0, runs=root / "runs", isolation_strict=strict
    )


@pytest.mark.slow
@pytest.mark.parametrize("strict", [True, False])
def test_folds_run_one_by_one_when_asked(tmp_path: Path, at_once: list[int], strict: bool) -> None:
    ready = prepared(tmp_path, strict=strict)
    agent = Scripted((arx(2), arx(3)))
    search(ready, agent, lambda *event: None, lambda view: None, LocalExecutor(3))
    assert len(at_once) > 6
    assert (max(at_once) == 1) is strict
    run = open_run(ready.directory)
    assert run.view.started.isolation_strict is strict
    words = "strict" in (ready.directory / "search_journal.md").read_text()
    assert words is strict
    if strict:
        # A run goes on as it began.
        again = prepared(tmp_path, strict=False)
        with pytest.raises(UserError, match=r"has isolation \w+, strict, not \w+: choose"):
            search(again, agent, lambda *event: None, lambda view: None)
