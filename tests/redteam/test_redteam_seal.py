"""A candidate looks for an encrypted test, its key and the run; never at level process, where it
would find them."""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import pytest

from asia.problem.load import init_problem
from asia.sandbox import Isolation

from .conftest import Arena


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


def test_no_candidate_reads(arena: Arena, sealed: dict[str, Path]) -> None:
    attempts = {f"read {what}": f"open({str(path)!r}, 'rb')" for what, path in sealed.items()}
    attempts |= {
        f"list {what}": f"os.listdir({str(path.parent)!r})" for what, path in sealed.items()
    }
    expected = {Isolation.NAMESPACE: "ENOENT", Isolation.LANDLOCK: "EACCES"}
    assert arena.ends(attempts) == dict.fromkeys(attempts, expected[arena.level])


def test_no_candidate_asks_the_desk(arena: Arena, tmp_path: Path) -> None:
    """The socket through which a coding agent hands in is not a candidate's."""
    path = tmp_path / "desk.sock"
    with socket.socket(socket.AF_UNIX) as desk:
        desk.bind(str(path))
        desk.listen()
        ask = f"socket.socket(socket.AF_UNIX).connect({str(path)!r})"
        assert arena.ends({"ask": ask}) == {"ask": "EPERM"}
        desk.settimeout(0.05)
        with pytest.raises(TimeoutError):
            desk.accept()
