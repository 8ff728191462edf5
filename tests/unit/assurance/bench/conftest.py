from collections.abc import Iterator
from pathlib import Path

import pytest

from asia.data.sources.official import PublishedFile
from tests.unit.painting import unpainted


@pytest.fixture(scope="package", autouse=True)
def unpainted_pictures() -> Iterator[None]:
    with unpainted():
        yield


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of made-up files, which no digest refuses."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(PublishedFile, "is_digest", lambda self, found: True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"
