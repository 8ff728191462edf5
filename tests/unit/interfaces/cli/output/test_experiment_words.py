"""Text of an agent in the output of status and show."""

import json
from dataclasses import replace

from asia.ledger.chain import BEGIN, decode, encode
from asia.ledger.events import Proposed
from tests.unit.interfaces.cli.conftest import Asia, Searched


def test_status_and_show_repeat_what_the_agent_remarked(asia: Asia, searched: Searched) -> None:
    runs = ("--runs", searched.runs)
    assert "remark" not in asia("status", searched.name, *runs).out
    ledger = searched.directory / "ledger.jsonl"
    place, kept = BEGIN, b""
    for raw in ledger.read_bytes().splitlines(keepends=True):
        event = decode(raw, place.seq, "ledger").event
        proposed = isinstance(event, Proposed)
        line = encode(place, replace(event, remark="the loop is closed")) if proposed else raw
        place, kept = place.behind(line), kept + line
        if proposed:
            break
    ledger.write_bytes(kept)
    assert "remark   the loop is closed" in asia("status", searched.name, *runs).out
    status = json.loads(asia("status", searched.name, "--json", *runs).out)
    assert status["remark"] == "the loop is closed"
    assert "remark      the loop is closed" in asia("show", searched.name, *runs).out
