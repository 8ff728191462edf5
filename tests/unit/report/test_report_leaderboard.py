from __future__ import annotations

import pytest

from asia.report import leaderboard


def test_the_published_results_of_the_cascaded_tanks() -> None:
    entries = leaderboard("cascaded_tanks")
    values = sorted(e.test_rmse for e in entries)
    assert len(entries) == 24
    assert (values[0], values[1], values[-1]) == (0.18, 0.221, 1.29)
    assert all(e.source.startswith("https://") and e.method and e.authors for e in entries)
    assert {e.year for e in entries} <= set(range(2017, 2027))


@pytest.mark.parametrize(
    "name", ["two_tanks_sim", "my_own", "", "..", "../problems/cascaded_tanks"]
)
def test_other_problems_have_none(name: str) -> None:
    assert leaderboard(name) == ()
