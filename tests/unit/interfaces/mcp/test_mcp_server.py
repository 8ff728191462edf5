from pathlib import Path

import anyio
import pytest
from mcp import Client, MCPError

from asia.interfaces.mcp.server import make_server
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.search.steering import Steering
from tests.unit.search.toy import CRASH, arx

from .conftest import SLOW, Agent, Setting


@pytest.fixture(autouse=True)
def _cold(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tools start the search, so that no thread does when the test is over."""
    monkeypatch.setattr("asia.interfaces.mcp.server._warm", lambda desk: None)


async def search(client: Client, directory: Path) -> None:
    agent = Agent(client)
    assert "candidate.py defines fit" in (await agent.call("problem"))["result"]
    first = await agent.submit(arx(2), family="arx", parent=1)
    progress: list[tuple[float, str | None]] = []

    async def told(done: float, total: float | None, message: str | None) -> None:
        progress.append((done, message))

    result = await client.call_tool("asia_wait", {"ticket": first}, progress_callback=told)
    assert not result.is_error
    assert progress[0][1] is not None
    good = await agent.judged(first)
    assert (good["experiment"], good["status"], good["parent"]) == (2, "keep", 1)
    assert good["V"] < 0.05
    assert len(good["folds"]) == 2

    bad = await agent.judged(await agent.submit(CRASH))
    assert (bad["V"], bad["folds"], bad["reason"]) == (None, [], "crash")
    assert bad["detail"] == "line 2: ValueError: no such luck"
    assert "correct the error at the line named below" in bad["advice"]

    again = await agent.call("submit", code=arx(2) + "# the same\n", hypothesis="h", expected="e")
    assert (again["ticket"], again["repeated"]) == (first, True)
    assert again["next"].startswith("not judged again: comments apart, this is the source of exp")
    tried = await agent.call("dry_run", code=arx(3))
    assert tried["reason"] is None
    assert tried["lines"][0].startswith("dry run  passed on ")
    assert (await agent.call("dry_run", code=CRASH))["reason"] == "crash"
    assert (await agent.call("status"))["remaining"] == 1
    last = await agent.call("wait", ticket=await agent.submit(arx(4)))
    while last["state"] != "done":
        last = await agent.call("wait", ticket=last["ticket"])
    assert last["remaining"] == 0
    assert last["next"].startswith("the budget is spent")
    assert "budget of 4 experiments is spent" in await agent.refused(
        "submit", code=arx(5), hypothesis="h", expected="e"
    )

    found = await agent.call("results", last=2)
    assert (found["total"], [r["experiment"] for r in found["results"]]) == (4, [3, 4])
    best = await agent.call("best")
    assert best == await agent.call("show", experiment=found["best"]["experiment"])
    assert best["code"] == arx(2 if best["experiment"] == 2 else 4)
    assert best["training"][0]["train_error"] < 0.05
    assert any(line.startswith("fold 1  block 1 of 2: ") for line in best["evidence"])
    assert last["evidence"]
    assert "evidence" not in found["results"][0]
    assert best["hypothesis"] == "it helps"

    ledger = await agent.text("asia://ledger")
    assert ledger.count("## Experiment") == 4
    assert "experiment\tval\tstatus" in ledger
    shown = await agent.text("asia://experiments/3")
    assert "no such luck" in shown
    assert CRASH.strip() in shown
    verify(directory)


@pytest.mark.long
def test_a_client_drives_a_whole_search(setting: Setting) -> None:
    async def main() -> None:
        async with Client(make_server(setting.opened())) as client:
            await search(client, setting.directory)

    anyio.run(main)
    view = open_run(setting.directory).view
    assert view.started.agent == "mcp"
    assert [e.proposed.ticket != "" for e in view.experiments] == [False, True, True, True]


def test_the_tools_are_few_short_and_annotated(setting: Setting) -> None:
    async def main() -> None:
        async with Client(make_server(setting.opened()), mode="legacy") as client:
            tools = (await client.list_tools()).tools
            assert len(tools) <= 10
            for tool in tools:
                assert tool.annotations is not None
                assert tool.annotations.read_only_hint is (
                    tool.name not in ("asia_submit", "asia_cancel")
                )
                assert tool.annotations.destructive_hint is (tool.name == "asia_cancel")
                assert tool.output_schema is not None
                assert tool.description is not None
                assert len(tool.description) < 400
            assert client.instructions is not None
            assert "asia_problem" in client.instructions
            names = {r.name for r in (await client.list_resources()).resources}
            assert names == {"problem", "ledger"}
            prompt = await client.get_prompt("asia_search", {"focus": "stay linear"})
            text = prompt.messages[0].content.text  # pyright: ignore
            for words in (
                "y: [0] y",
                "asia_wait(ticket)",
                "is an instruction to you",
                "stay linear",
            ):
                assert words in text
            assert await Agent(client).text("asia://problem") in text

    anyio.run(main)


@pytest.mark.slow
def test_what_an_agent_does_wrong_is_told_in_words_it_can_use(setting: Setting) -> None:
    async def main() -> None:
        async with Client(make_server(setting.opened())) as client:
            agent = Agent(client)
            words = {"hypothesis": "h", "expected": "e"}
            for arguments, answer in (
                ({"code": "def fit(:", **words}, "line 1"),
                ({"code": "x = 1", **words}, "cost no experiment"),
                ({"code": arx(2), **words, "hypothesis": " "}, "needs a hypothesis"),
                ({"code": arx(2), **words, "parent": 9}, "parent 9: expected an experiment"),
                ({"code": arx(2)}, "hypothesis"),
            ):
                assert answer in await agent.refused("submit", **arguments)
            for ticket in ("nonsense", "../order", "\0"):
                assert "no submission has the ticket" in await agent.refused("wait", ticket=ticket)
                assert "no submission has the ticket" in await agent.refused(
                    "cancel", ticket=ticket
                )
            assert "less than or equal to 45" in await agent.refused(
                "wait", ticket="x", timeout_s=600
            )
            assert "has no experiment 7" in await agent.refused("show", experiment=7)
            with pytest.raises(MCPError, match="no experiment '7'"):
                await agent.text("asia://experiments/7")

    anyio.run(main)


@pytest.mark.long
def test_words_of_a_candidate_are_bounded_wherever_they_are_shown(setting: Setting) -> None:
    loud = "def fit(t, c):\n    raise ValueError('\\x1b[31m' + 5000 * 'y')\n"

    async def main() -> None:
        async with Client(make_server(setting.opened(2))) as client:
            agent = Agent(client)
            said = {"hypothesis": "a\x1b\nb" + 9000 * "c", "expected": 9000 * "d"}
            result = await agent.judged(await agent.submit(loud, **said))
            assert len(result["detail"]) == 300
            shown = await agent.call("show", experiment=2)
            ledger = await agent.text("asia://ledger")
            experiment = await agent.text("asia://experiments/2")
            for text in (result["detail"], shown["hypothesis"], ledger, experiment):
                assert "\x1b" not in text
            assert all(len(line) < 2300 for line in ledger.splitlines())
            assert len(shown["hypothesis"]) == len(shown["expected"]) == 2000

    anyio.run(main)


@pytest.mark.slow
def test_taking_back(setting: Setting) -> None:
    async def main() -> None:
        async with Client(make_server(setting.opened())) as client:
            agent = Agent(client)
            running = await agent.submit(SLOW)
            queued = await agent.submit(arx(4))
            assert (await agent.call("cancel", ticket=queued))["state"] == "withdrawn"
            assert "no submission has the ticket" in await agent.refused("wait", ticket=queued)
            state = "queued"
            while state == "queued":
                state = (await agent.call("wait", ticket=running, timeout_s=0))["state"]
            assert state == "running"
            assert "is being evaluated as experiment 2" in await agent.refused(
                "cancel", ticket=running
            )
            assert (await agent.judged(running))["V"] is not None
            assert "is done: only a queued one" in await agent.refused("cancel", ticket=running)
            assert (await agent.call("status"))["remaining"] == 2

    anyio.run(main)


@pytest.mark.long
def test_a_person_steers_and_stops_it(setting: Setting) -> None:
    async def main() -> None:
        async with Client(make_server(setting.opened())) as client:
            agent = Agent(client)
            Steering(setting.directory).steer("keep it linear")
            first = await agent.call("wait", ticket=await agent.submit(arx(2)))
            while not first["notes"]:
                first = await agent.call("wait", ticket=first["ticket"])
            assert first["notes"] == ["keep it linear"]
            Steering(setting.directory).stop()
            while (await agent.call("status"))["state"] == "running":
                await anyio.sleep(0.05)
            words = {"hypothesis": "h", "expected": "e"}
            assert "the user stopped this search" in await agent.refused(
                "submit", code=arx(3), **words
            )
            setting.opened()
            assert (await agent.judged(await agent.submit(arx(3))))["V"] is not None

    anyio.run(main)


def test_a_search_that_cannot_start_is_told_to_the_agent(setting: Setting) -> None:
    async def main() -> None:
        opened = setting.opened()
        async with Client(make_server(opened)) as client:
            (setting.problem / "problem.toml").write_text("nonsense = 1\n")
            assert "the search did not start: problem.toml" in await Agent(client).refused("status")

    anyio.run(main)
