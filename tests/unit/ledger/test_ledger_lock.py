import fcntl
import threading
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger import Chain, in_use


def test_a_glance_at_the_lock_does_not_keep_a_search_out(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    path.touch()
    with path.open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        threading.Timer(0.03, lambda: fcntl.flock(reader, fcntl.LOCK_UN)).start()
        with Chain(path):
            assert in_use(path)


def test_a_second_search_is_kept_out(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    with Chain(path), pytest.raises(UserError, match="in use by another search"):
        Chain(path)
    assert not in_use(path)
