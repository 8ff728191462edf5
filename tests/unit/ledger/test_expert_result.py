"""The expert's result beside a search that costs money."""

from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents.expert_result import ExpertResult, expert_result, expert_text
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Stopped

from .conftest import evaluated, proposed, score, started

PAID = replace(started(), run="paid", agent="llm", seed=1)


def expert(runs: Path, seed: int, values: list[float], reason: str | None = None) -> None:
    name = f"expert-{seed}"
    store = Store(runs / name / "artifacts")
    with Chain(runs / name / "ledger.jsonl") as chain:
        chain.append(replace(started(), run=name, seed=seed))
        for number, value in enumerate(values, 1):
            chain.append(proposed(store, number))
            chain.append(evaluated(number, "discard", score(value)))
        if reason is not None:
            chain.append(Stopped(reason))  # type: ignore[arg-type]


def test_only_what_costs_money_has_a_control(tmp_path: Path) -> None:
    expert(tmp_path, 0, [0.5, 0.4])
    assert expert_result(tmp_path / "other", replace(PAID, agent="random"), 2) is None
    assert expert_result(tmp_path / "paid", PAID, 0) is None


def test_the_same_seed_counts_and_no_more_than_the_same_experiments(tmp_path: Path) -> None:
    expert(tmp_path, 0, [0.1, 0.1, 0.1])
    assert expert_result(tmp_path / "paid", PAID, 2) == ExpertResult("expert-0", 0.1, 2)
    expert(tmp_path, 1, [0.5, 0.4, 0.3])
    found = expert_result(tmp_path / "paid", PAID, 2)
    assert found == ExpertResult("expert-1", 0.4, 2)
    assert "the same 2 experiments: V=0.4000 (expert-1)" in expert_text(found, PAID)


@pytest.mark.parametrize(("reason", "counts"), [("budget", True), (None, False)])
def test_a_shorter_search_counts_once_it_has_ended(
    tmp_path: Path, reason: str | None, counts: bool
) -> None:
    expert(tmp_path, 1, [0.5], reason)
    found = expert_result(tmp_path / "paid", PAID, 2)
    assert found == (ExpertResult("expert-1", 0.5, 2) if counts else ExpertResult(None, None, 2))


def test_a_control_whose_ledger_was_changed_is_none(tmp_path: Path) -> None:
    expert(tmp_path, 1, [0.5, 0.4])
    ledger = tmp_path / "expert-1" / "ledger.jsonl"
    ledger.write_bytes(ledger.read_bytes().replace(b"0.4", b"0.9"))
    assert expert_result(tmp_path / "paid", PAID, 2) == ExpertResult(None, None, 2)
