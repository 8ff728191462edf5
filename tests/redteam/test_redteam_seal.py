"""A candidate looks for an encrypted test, its key and the run; never at level process, where it
would find them."""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import pytest

from asia.errors import CandidateError, Reason
from asia.problem.load import init_problem
from asia.sandbox import Isolation

from .conftest import LEVELS, Arena, arena_at
from .test_redteam_attacks import candidate


@pytest.fixture(params=[LEVELS[Isolation.NAMESPACE], LEVELS[Isolation.LANDLOCK]], ids=str)
def arena(request):
    with arena_at(request.param) as arena:
        yield arena


@pytest.fixture
def sealed(tmp_path: Path) -> dict[str, Path]:
    rows = np.random.default_rng(0).normal(size=(200, 2))
    for name in ("train", "test"):
        table = "\n".join(["u,y", *(f"{u!r},{y!r}" for u, y in rows.tolist())])
        (tmp_path / f"{name}.csv").write_text(table)
    made = init_problem(
        tmp_path / "toy", train=[tmp_path / "train.csv"], test=[tmp_path / "test.csv"],
        inputs=["u"], outputs=["y"], sampling_time=1.0, seal=True, keys=tmp_path / "keys",
    )  # fmt: skip
    assert made.store is not None
    assert made.key is not None
    ledger = tmp_path / "runs" / "toy" / "ledger.jsonl"
    ledger.parent.mkdir(parents=True)
    ledger.write_text("{}\n")
    return {
        "store": made.store,
        "key": made.key,
        "ledger": ledger,
        "train": tmp_path / "train.csv",
    }


@pytest.mark.parametrize("what", ["store", "key", "ledger", "train"])
def test_no_candidate_reads(arena: Arena, sealed: dict[str, Path], what: str) -> None:
    path = sealed[what]
    for attempt in (f"open({str(path)!r}, 'rb').read()", f"os.listdir({str(path.parent)!r})"):
        with pytest.raises(CandidateError) as caught:
            arena.run(candidate(fit=attempt))
        assert caught.value.reason is Reason.CRASH
        expected = {Isolation.NAMESPACE: "FileNotFoundError", Isolation.LANDLOCK: "PermissionError"}
        assert expected[arena.level] in caught.value.detail


def test_no_candidate_asks_the_desk(arena: Arena, tmp_path: Path) -> None:
    """The socket through which a coding agent hands in is not a candidate's."""
    path = tmp_path / "desk.sock"
    with socket.socket(socket.AF_UNIX) as desk:
        desk.bind(str(path))
        desk.listen()
        ask = f"socket.socket(socket.AF_UNIX).connect({str(path)!r})"
        with pytest.raises(CandidateError) as caught:
            arena.run(candidate(fit=f"import socket\n{ask}"))
        assert "Error" in caught.value.detail
        desk.settimeout(0.05)
        with pytest.raises(TimeoutError):
            desk.accept()
