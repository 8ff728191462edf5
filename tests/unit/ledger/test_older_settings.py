"""Ledgers of older versions: what is read, and settings that are refused."""

import pytest
from pydantic import TypeAdapter

from asia.errors import UserError
from asia.ledger.chain import BEGIN, decode, encode
from asia.ledger.events import Fit

from .conftest import started

LEGS = b'"legs":[{"agent":"expert","experiments":2,"settings":{}},{"agent":"bayes"}],'


@pytest.mark.parametrize("setting", [b"", b'"legs":[],"ladder":null,'])
def test_a_ledger_without_them_is_read(setting: bytes) -> None:
    raw = encode(BEGIN, started())
    assert decode(raw.replace(b'"seed":', setting + b'"seed":', 1), 0, "old").event == started()


@pytest.mark.parametrize("setting", [LEGS, b'"ladder":0.1,', b'"stop_folds":true,'])
def test_a_ledger_with_one_is_refused(setting: bytes) -> None:
    raw = encode(BEGIN, started())
    with pytest.raises(UserError, match="event 0 was written by another version of ASIA"):
        decode(raw.replace(b'"seed":', setting + b'"seed":', 1), 0, "old")


def test_a_change_of_the_agent_is_refused() -> None:
    raw = encode(BEGIN, started()).replace(b'"event":"started"', b'"event":"handed_over"')
    with pytest.raises(UserError, match="event 0 was written by another version of ASIA"):
        decode(raw, 0, "old")


@pytest.mark.parametrize(
    ("older", "value", "failed"),
    [
        ({"value": 0.2, "folds": [0.2, 0.2], "same": False, "seconds": 1.0}, 0.2, ""),
        ({"failed": "crash", "seconds": 1.0}, None, "crash"),
        ({"error": 0.3, "disagreement": 0.1, "objection": "it diverged"}, 0.3, "it diverged"),
        ({"fold": 2, "ratio": 1.0, "failed": ""}, 1.0, ""),
    ],
)
def test_a_further_fit_is_read(older: dict[str, object], value: float | None, failed: str) -> None:
    found = TypeAdapter(Fit).validate_python(older)
    assert (found.value, found.failed) == (value, failed)
