"""asia validate --repeat, and what status and show say of it."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from asia.judge.scoring.repeated_fits import ExpectedError, Interval
from asia.ledger.events import Confirmed, ConfirmedCandidate, ConfirmedPair
from asia.presentation.results import confirmation_blocks, confirmation_verdict
from asia.presentation.table import block_lines
from tests.unit.interfaces.cli.conftest import Asia, Searched


def candidate(number: int, value: float, best: int, worst: int) -> ConfirmedCandidate:
    interval = Interval(value, value - 0.01, value + 0.01)
    return ConfirmedCandidate(number, value - 0.005, interval, 0.004, 5, 0, False, best, worst)


FOUND = Confirmed(
    best=12,
    seeds=5,
    tried=15,
    level=0.95,
    candidates=(candidate(9, 0.1, 1, 2), candidate(12, 0.101, 1, 2), candidate(3, 0.2, 3, 3)),
    pairs=(
        ConfirmedPair(9, 12, Interval(0.001, -0.004, 0.006)),
        ConfirmedPair(9, 3, Interval(0.1, 0.08, 0.12)),
        ConfirmedPair(12, 3, Interval(0.099, 0.08, 0.12)),
    ),
    noise=0.004,
    expected=ExpectedError(0.11, 0.09, 0.14, 0.009),
)


def test_words_that_a_person_understands() -> None:
    text = "\n".join(block_lines(confirmation_blocks(FOUND)))
    plain = re.sub(" +", " ", text)
    assert "#09 and #12 +0.0010 (-0.0040 to +0.0060) statistically equal" in plain
    assert "#12 and #03 +0.0990 (+0.0800 to +0.1200) #12 is better" in plain
    assert "#12 1 to 2 0.1010 (0.0910 to 0.1110)" in plain
    assert "#03 3 0.2000" in plain
    assert "selection from 15 candidates" in text
    assert "one fold model 0.1100 0.0900 to 0.1400" in plain
    assert "after the sealed test" not in text
    assert "after the sealed test" in "\n".join(
        block_lines(confirmation_blocks(replace(FOUND, after_unsealing=True)))
    )


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (FOUND, "#12 and #09 are statistically equal"),
        (replace(FOUND, best=9, pairs=FOUND.pairs[1:]), "#09 is confirmed"),
        (replace(FOUND, best=3), "#03 is not confirmed: #09 and #12 are better"),
        (replace(FOUND, best=7), "#07 is not confirmed: it was not repeated"),
        (replace(FOUND, failed=(12,)), "failed with every other seed"),
        (replace(FOUND, candidates=FOUND.candidates[1:2], pairs=()), "the only candidate repeated"),
    ],
)
def test_the_verdict(found: Confirmed, words: str) -> None:
    assert words in confirmation_verdict(found)


def test_the_command_tells_progress_and_result_and_status_and_show_repeat_it(
    asia: Asia, searched: Searched
) -> None:
    runs = ("--runs", searched.runs)
    assert "confirm " not in asia("status", searched.name, *runs).out
    done = asia("validate", searched.name, "--repeat", "--seeds", 2, *runs)
    assert done.code == 0, done.err
    assert "#01 seed 1: V=" in done.err
    assert "variance over seeds: " in done.out
    assert "expected error of #01 on a new record" in done.out
    again = asia("validate", searched.name, "--repeat", "--seeds", 2, *runs)
    assert "nothing new to fit" in again.err
    assert again.out == done.out
    assert (
        "confirm  #01 was the only candidate repeated" in asia("status", searched.name, *runs).out
    )
    assert "fitted again from other seeds:" in asia("show", searched.name, *runs).out
    found = json.loads(
        asia("validate", searched.name, "--repeat", "--seeds", 2, "--json", *runs).out
    )
    assert (found["best"], found["new"]) == (1, False)
    status = json.loads(asia("status", searched.name, "--json", *runs).out)
    assert status["confirmed"]["best"] == 1
    assert asia("verify", searched.name, *runs).code == 0


def test_what_cannot_be_confirmed_is_refused_with_a_sentence(
    asia: Asia, searched: Searched
) -> None:
    ledger = searched.directory / "ledger.jsonl"
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:-2]))
    done = asia("validate", searched.name, "--repeat", "--runs", searched.runs)
    assert done.code == 2
    assert "not finished" in done.err
