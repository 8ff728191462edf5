"""Updates of an open page as the ledger grows."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from asia.candidate import source_digest
from asia.errors import UserError
from asia.interfaces.view import streams as _streams
from asia.interfaces.view.followed import FollowedRun, RunFolder
from asia.interfaces.view.streams import Streams
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain, Follower
from asia.ledger.events import Proposed
from asia.ledger.run import open_run
from asia.problem.problem import Problem
from asia.search.steering import RunningLosses, Steering
from tests.unit.report.made_up import append_experiment

from .conftest import make_run


async def next_message(messages: AsyncIterator[str]) -> dict[str, Any]:
    """The next one that is an event, with its data."""
    async for message in messages:
        fields = dict(line.split(": ", 1) for line in message.strip().split("\n"))
        if "event" in fields:
            return {**fields, "data": json.loads(fields["data"])}
    raise AssertionError("the stream ended")


def grow(directory: Path, problem: Problem, number: int, title: str, value: float | None) -> None:
    with Chain(directory / "ledger.jsonl") as chain:
        append_experiment(chain, Store(directory / "artifacts"), problem, number, title, value, 0.1)


def test_a_new_experiment_is_sent_once(runs: Path, problem: Problem) -> None:
    followed = FollowedRun(runs / "made")

    async def story() -> list[dict[str, Any]]:
        streams = Streams()
        messages = streams.of_run(followed, followed.snapshot().mark)
        found = [await next_message(messages)]
        grow(runs / "made", problem, 5, "<b>fifth</b>", 0.3)
        found.append(await next_message(messages))
        streams.end()
        assert [message async for message in messages] == []
        return found

    first, second = asyncio.run(asyncio.wait_for(story(), 60))
    assert first["data"]["rows"] == []
    (row,) = second["data"]["rows"]
    assert row["number"] == 5
    assert "&lt;b&gt;fifth&lt;/b&gt;" in row["html"]
    assert second["data"]["said"] == "Experiment 5, discard, V 0.3000: <b>fifth</b>"
    assert second["id"] == followed.snapshot().mark


def test_a_page_catches_up_with_a_server_that_was_started_again(
    runs: Path, problem: Problem
) -> None:
    mark = FollowedRun(runs / "made").snapshot().mark
    for number in (5, 6):
        grow(runs / "made", problem, number, f"title {number}", None)

    async def story() -> dict[str, Any]:
        return await next_message(Streams().of_run(FollowedRun(runs / "made"), mark))

    found = asyncio.run(asyncio.wait_for(story(), 60))
    assert [row["number"] for row in found["data"]["rows"]] == [6, 5]
    assert found["data"]["said"] == ""


@pytest.mark.parametrize("mark", ["", "3-" + "0" * 20, "900-" + "0" * 20, "x", "-1-x", "2-"])
def test_a_page_of_another_ledger_loads_anew(runs: Path, mark: str) -> None:
    async def story() -> dict[str, Any]:
        return await next_message(Streams().of_run(FollowedRun(runs / "made"), mark))

    assert asyncio.run(asyncio.wait_for(story(), 60))["event"] == "anew"


def test_a_search_that_is_resumed_is_running_again(runs: Path) -> None:
    followed = FollowedRun(runs / "made")

    async def story() -> list[dict[str, Any]]:
        messages = Streams().of_run(followed, followed.snapshot().mark)
        found = [await next_message(messages)]
        with Chain(runs / "made" / "ledger.jsonl"):
            found.append(await next_message(messages))
        found.append(await next_message(messages))
        return found

    found = asyncio.run(asyncio.wait_for(story(), 60))
    assert [one["data"]["running"] for one in found] == [False, True, False]
    assert "interrupted" in found[2]["data"]["parts"]["now"]


def test_a_pause_that_was_asked_for_is_shown(runs: Path) -> None:
    followed = FollowedRun(runs / "made")

    async def story() -> str:
        with Chain(runs / "made" / "ledger.jsonl"):
            messages = Streams().of_run(followed, followed.snapshot().mark)
            first = await next_message(messages)
            assert "to pause" not in first["data"]["parts"]["now"]
            Steering(runs / "made").pause()
            return (await next_message(messages))["data"]["parts"]["now"]

    assert "running, to pause" in asyncio.run(asyncio.wait_for(story(), 60))


def test_the_loss_of_a_running_fit_is_sent_without_a_new_line(runs: Path, problem: Problem) -> None:
    directory = runs / "made"
    source = "x = 1\n"
    with Chain(directory / "ledger.jsonl") as chain:
        name = Store(directory / "artifacts").put(source.encode())
        chain.append(
            Proposed(5, 1, "refine", "arx", "fitting", "", "", name, source_digest(source))
        )
        followed = FollowedRun(directory)

        async def story() -> list[dict[str, Any]]:
            messages = Streams().of_run(followed, followed.snapshot().mark)
            found = [await next_message(messages)]
            RunningLosses(directory)(source, 2, 40.0, 0.125)
            return [*found, await next_message(messages)]

        first, second = asyncio.run(asyncio.wait_for(story(), 60))
    assert "loss" not in first["data"]["parts"]["now"]
    assert "<span>fold 2: loss 0.125 at step 40</span>" in second["data"]["parts"]["now"]
    assert (second["id"], second["data"]["rows"]) == (first["id"], [])


def test_a_run_that_was_removed_is_told_of_once(runs: Path) -> None:
    followed = FollowedRun(runs / "made")

    async def story() -> list[dict[str, Any]]:
        streams = Streams()
        messages = streams.of_run(followed, followed.snapshot().mark)
        found = [await next_message(messages)]
        (runs / "made").rename(runs / "elsewhere")
        found.append(await next_message(messages))
        rest = asyncio.ensure_future(next_message(messages))
        await asyncio.sleep(0.4)
        assert not rest.done()
        (runs / "elsewhere").rename(runs / "made")
        return [*found, await rest]

    found = asyncio.run(asyncio.wait_for(story(), 60))
    assert [one["event"] for one in found] == ["news", "trouble", "news"]
    assert "is gone" in found[1]["data"]["words"]


def test_a_page_that_missed_very_much_loads_anew(
    runs: Path, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = FollowedRun(runs / "made").snapshot().mark
    for number in (5, 6):
        grow(runs / "made", problem, number, "title", None)
    monkeypatch.setattr(_streams, "FIRST", 1)

    async def story() -> dict[str, Any]:
        return await next_message(Streams().of_run(FollowedRun(runs / "made"), mark))

    assert asyncio.run(asyncio.wait_for(story(), 60))["event"] == "anew"


def test_the_list_is_sent_when_it_changes(runs: Path, problem: Problem) -> None:
    async def story() -> list[dict[str, Any]]:
        messages = Streams().of_list(RunFolder(runs), "")
        found = [await next_message(messages)]
        make_run(runs / "other", problem)
        found.append(await next_message(messages))
        return found

    first, second = asyncio.run(asyncio.wait_for(story(), 60))
    assert "/runs/other" not in first["data"]["parts"]["list"]
    assert "/runs/other" in second["data"]["parts"]["list"]


def test_a_follower_reads_each_line_once_and_knows_every_place(
    runs: Path, problem: Problem
) -> None:
    ledger = runs / "made" / "ledger.jsonl"
    follower = Follower(ledger)
    assert follower.read()
    assert not follower.read()
    count, head = len(follower.lines), follower.head
    grow(runs / "made", problem, 5, "fifth", 0.3)
    assert follower.read()
    assert follower.lines == list(open_run(runs / "made").lines)
    assert follower.view.experiments[-1].number == 5
    assert follower.head_at(count) == head
    assert follower.head_at(len(follower.lines)) == follower.head
    assert follower.head_at(900) == ""


def test_a_follower_waits_for_the_end_of_a_line(runs: Path, problem: Problem) -> None:
    ledger = runs / "made" / "ledger.jsonl"
    whole = ledger.read_bytes()
    ledger.write_bytes(whole[:-40])
    follower = Follower(ledger)
    follower.read()
    count = len(follower.lines)
    with ledger.open("ab") as stream:
        stream.write(whole[-40:])
    assert follower.read()
    assert len(follower.lines) == count + 1


def test_a_follower_begins_anew_with_another_ledger(runs: Path, problem: Problem) -> None:
    ledger = runs / "made" / "ledger.jsonl"
    follower = Follower(ledger)
    follower.read()
    other = make_run(runs / "other", problem, (("other", 0.4),)) / "ledger.jsonl"
    ledger.write_bytes(other.read_bytes())
    assert follower.read()
    assert follower.view.started.run == "other"
    other.replace(ledger)
    follower.read()
    assert follower.lines == list(open_run(runs / "made").lines)


def test_a_follower_takes_a_line_that_replaces_an_unconfirmed_one(
    runs: Path, problem: Problem
) -> None:
    ledger = runs / "made" / "ledger.jsonl"
    whole = ledger.read_bytes()
    grow(runs / "made", problem, 5, "never confirmed", 0.3)
    follower = Follower(ledger)
    follower.read()
    ledger.write_bytes(whole)
    grow(runs / "made", problem, 5, "written in its place, and longer", 0.2)
    assert follower.read()
    assert follower.lines == list(open_run(runs / "made").lines)


def test_a_ledger_that_was_changed_is_refused(runs: Path) -> None:
    ledger = runs / "made" / "ledger.jsonl"
    follower = Follower(ledger)
    follower.read()
    ledger.write_bytes(ledger.read_bytes().replace(b"first", b"FIRST"))
    grown = ledger.read_bytes()
    ledger.write_bytes(grown[: len(grown) // 2])
    with pytest.raises(UserError, match="was changed after it was written"):
        follower.read()
