"""Comparison of agents on a toy problem, with scripted agents."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from scipy.stats import binomtest

from asia.agents.registry import NamedAgent
from asia.analysis.comparison import (
    Pair,
    Views,
    experiments_to_reach,
    pairs_of,
    plan_searches,
    rows_of,
)
from asia.errors import UserError
from asia.problem.load import load_problem
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem


def agent(name: str, *sources: str) -> tuple[str, Any]:
    return name, lambda: NamedAgent(Scripted(sources, name))


@pytest.mark.slow
def test_agents_are_compared_at_equal_budget(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    agents = [agent("good", arx(2), CRASH), agent("bad", CRASH, arx(3))]
    searches = plan_searches(problem, agents, (0, 1), 3)
    assert [s.run for s in searches] == [
        f"compare-toy-{name}-inner-s{seed}" for seed in (0, 1) for name in ("good", "bad")
    ]
    events: list[object] = []
    views = {
        (s.agent, s.seed): s.search(tmp_path / "runs", lambda e, _: events.append(e))
        for s in searches
    }
    assert {len(view.finished) for view in views.values()} == {3}
    rows = {row.model: row for row in rows_of(views)}
    assert list(rows)[-3:] == ["baseline of the problem", "good, best of 3", "bad, best of 3"]
    best = [views["good", seed].best_value for seed in (0, 1)]
    assert list(rows["good, best of 3"].values) == best
    assert rows["good, best of 3"].median == pytest.approx(sum(v or 0 for v in best) / 2)
    assert rows["linear model"].runs == 2
    (reached,) = experiments_to_reach(views)
    assert (reached.agent, reached.other, set(reached.experiments)) == ("good", "bad", {0, 1})
    # The same searches again are only read.
    events.clear()
    again = searches[0].search(tmp_path / "runs", lambda e, _: events.append(e))
    assert not events
    assert again.best_value == best[0]


def made_up(best: dict[str, list[float | None]]) -> Views:
    def experiment(number: int, value: float | None) -> Any:
        score = None if value is None else SimpleNamespace(value=value)
        return SimpleNamespace(number=number, score=score, unconfirmed=number == 1)

    return cast(
        Views,
        {
            (name, seed): SimpleNamespace(
                best_value=value,
                finished=[experiment(k + 1, value and value + 2 - k) for k in range(3)],
            )
            for name, values in best.items()
            for seed, value in enumerate(values)
        },
    )


def test_pairs_are_of_seeds_with_two_scores() -> None:
    views = made_up({"a": [1.0, 2.0, None, 1.0, 1.0], "b": [2.0, 1.0, 1.0, 2.5, 4.0]})
    (pair,) = pairs_of(views)
    assert pair.ratios == (0.5, 2.0, 0.4, 0.25)
    assert Pair("a", "b", (1.0, 1.0)).p is None
    all_better = Pair("a", "b", (0.5, 0.6, 0.7, 0.8, 0.9))
    assert all_better.p == pytest.approx(binomtest(5, 5).pvalue)
    assert pairs_of(made_up({"a": [1.0]})) == ()


def test_experiments_to_the_best_of_another() -> None:
    views = made_up({"expert": [1.0, 1.0, 1.0], "random": [2.1, 0.5, None]})
    (reached,) = experiments_to_reach(views)
    # V of the expert: 3 (unconfirmed), 2, 1.
    assert (reached.agent, reached.other) == ("expert", "random")
    assert reached.experiments == {0: 2, 1: None, 2: None}


def test_every_agent_and_seed_once(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    with pytest.raises(UserError, match="every seed once, got: 1, 1"):
        plan_searches(problem, [agent("a")], (1, 1))
    with pytest.raises(UserError, match="every agent once, got: none"):
        plan_searches(problem, [], (1,))
