"""Benchmarks of the suite with long records."""

from pathlib import Path

import pytest

from tests.unit.assurance.bench.suite_searches import check_and_search


@pytest.mark.long
@pytest.mark.parametrize("name", ["silverbox", "wiener_hammerstein", "f16"])
def test_each_is_checked_and_searched(
    name: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_and_search(name, files, monkeypatch)
