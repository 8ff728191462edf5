"""Artifacts are checked the same, whether here or by the processes that share the work."""

from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger.artifacts import Artifacts, Store


@pytest.fixture(params=[4, 512], ids=["shared", "here"])
def kept(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[Path]:
    """Thirty files, the last of them of more than one read."""
    monkeypatch.setattr("asia.ledger.artifacts._BATCH", request.param)
    store = Store(tmp_path / "artifacts")
    names = [store.put(bytes([n]) * (300_000 if n == 29 else n)) for n in range(30)]
    return [tmp_path / "artifacts" / name for name in names]


def check(kept: list[Path]) -> int:
    with Artifacts(kept[0].parent) as artifacts:
        for record, path in enumerate(kept + kept):
            artifacts.add(path.name, record)
        artifacts.check()
        return len(artifacts)


def test_sound_artifacts_are_counted_once(kept: list[Path]) -> None:
    assert check(kept) == 30


@pytest.mark.parametrize("which", [0, 13, 28, 29])
def test_a_changed_artifact_is_named_with_its_record(kept: list[Path], which: int) -> None:
    kept[which].write_bytes(kept[which].read_bytes() + b"1")
    with pytest.raises(UserError, match=rf"event {which} of .*{kept[which].name} was changed"):
        check(kept)


def test_of_several_the_first_record_is_named(kept: list[Path]) -> None:
    kept[21].write_bytes(b"1")
    kept[18].unlink()
    with pytest.raises(UserError, match=rf"event 18 of .*{kept[18].name} is missing"):
        check(kept)


def test_no_artifacts_at_all(kept: list[Path]) -> None:
    for path in kept:
        path.unlink()
    kept[0].parent.rmdir()
    with pytest.raises(UserError, match=r"event 0 of .* has a ledger without artifacts"):
        check(kept)
