"""Benchmarks of the suite with many records or channels."""

from pathlib import Path

import pytest

from tests.unit.assurance.bench.suite_searches import check_and_search


@pytest.mark.long
@pytest.mark.parametrize("name", ["fine_steering_mirror", "parallel_wiener_hammerstein"])
def test_each_is_checked_and_searched(
    name: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two minutes an experiment: the baseline and one more.
    check_and_search(name, files, monkeypatch, experiments=2)
