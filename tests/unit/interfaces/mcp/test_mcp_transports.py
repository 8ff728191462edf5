import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import anyio
import httpx2
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.streamable_http import streamable_http_client

from asia.errors import UserError
from asia.interfaces.mcp.config import client_configuration
from asia.interfaces.mcp.http import serve
from asia.ledger.run import open_run
from tests.unit.interfaces.workspace.desks import searches
from tests.unit.search.toy import arx

from .conftest import SLOW, Agent, Setting

TOKEN = "a token for this test only"


def stdio(setting: Setting, experiments: int = 3) -> StdioServerParameters:
    """As the configuration printed for a client has it."""
    words = [str(setting.problem), "--runs", str(setting.runs), "--experiments", str(experiments)]
    text = client_configuration("claude", words, {}).text
    server = json.loads(text)["mcpServers"]["asia"]
    return StdioServerParameters(command=server["command"], args=server["args"], cwd="/")


def servers(setting: Setting) -> list[int]:
    """Processes of `asia agent mcp` for these runs."""
    found: list[int] = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"mcp" in words and os.fsencode(setting.runs) in words:
                found.append(int(entry.name))
    return found


@pytest.mark.slow
def test_killing_the_server_loses_nothing(setting: Setting) -> None:
    async def until_killed() -> tuple[str, str]:
        async with Client(stdio(setting)) as client:
            agent = Agent(client)
            running = await agent.submit(SLOW)
            queued = await agent.submit(arx(2))
            state = "queued"
            while state == "queued":
                state = (await agent.call("wait", ticket=running, timeout_s=0))["state"]
            assert state == "running"
            (server,) = servers(setting)
            os.kill(server, signal.SIGKILL)
            return running, queued

    running, queued = anyio.run(until_killed)
    assert servers(setting) == []
    assert len(searches(setting.directory)) == 1

    async def again() -> None:
        async with Client(stdio(setting)) as client:
            agent = Agent(client)
            first = await agent.call("wait", ticket=running, timeout_s=0)
            assert first["state"] in ("running", "done")
            assert (await agent.judged(running))["experiment"] == 2
            assert (await agent.judged(queued))["experiment"] == 3
            assert (await agent.call("results"))["total"] == 3

    anyio.run(again)
    view = open_run(setting.directory).view
    assert [e.number for e in view.finished] == [1, 2, 3]


@contextmanager
def http(setting: Setting, *words: str) -> Iterator[tuple[str, str]]:
    """URL of a server that runs, and what else it said."""
    command = stdio(setting)
    process = subprocess.Popen(
        [command.command, *command.args, "--http", "127.0.0.1:0", *words],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "ASIA_TEST_TOKEN": TOKEN},
    )
    assert process.stderr is not None
    with process, process.stderr:
        try:
            lines = iter(process.stderr.readline, "")
            url = next(line for line in lines if "http://" in line).removeprefix("asia: ").strip()
            said = "" if words else process.stderr.readline()
            yield url, said
        finally:
            process.terminate()
            process.wait()


def status(url: str, *authorization: str) -> int:
    headers = [("Authorization", value) for value in authorization]
    return httpx2.post(
        url, json={"jsonrpc": "2.0", "method": "ping", "id": 1}, headers=headers
    ).status_code


@pytest.mark.long
def test_a_search_over_http(setting: Setting) -> None:
    async def main(url: str) -> None:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=60.0) as transport,
            Client(streamable_http_client(url, http_client=transport)) as client,
        ):
            agent = Agent(client)
            assert (await agent.judged(await agent.submit(arx(2))))["V"] < 0.05
            best = await agent.call("best")
            assert best["code"] == arx(2)

    with http(setting, "--token-env", "ASIA_TEST_TOKEN") as (url, _):
        anyio.run(main, url)
        for refused in ((), ("Bearer wrong",), (TOKEN,), (f"Bearer {TOKEN}", "Bearer wrong")):
            assert status(url, *refused) == 401
        assert status(url, f"Bearer {TOKEN}") != 401
        (search,) = searches(setting.directory)
        environment = Path(f"/proc/{search}/environ").read_bytes()
        assert TOKEN.encode() not in environment
        assert httpx2.post(
            url, headers={"Authorization": f"Bearer {TOKEN}", "Host": "evil.example"}
        ).status_code in (400, 403, 421)


@pytest.mark.long
def test_a_token_is_made_up_and_told_once(setting: Setting) -> None:
    with http(setting) as (url, said):
        token = said.removeprefix("asia: token ").strip()
        assert len(token) >= 32
        assert status(url) == 401
        assert status(url, f"Bearer {token}") != 401
        end = time.monotonic() + 60
        while not searches(setting.directory) and time.monotonic() < end:
            time.sleep(0.05)
    files = [p for p in setting.directory.rglob("*") if p.is_file()]
    assert not any(token.encode() in p.read_bytes() for p in files)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("8765", "expected HOST:PORT"),
        ("127.0.0.1:http", "expected HOST:PORT"),
        ("127.0.0.1:99999", "expected HOST:PORT"),
        ("0.0.0.0:8765", "expected a host of this machine"),
        ("example.org:80", "the token is not encrypted"),
    ],
)
def test_an_address_must_be_of_this_machine(setting: Setting, address: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        serve(setting.opened(), address, None)


def test_a_token_from_the_environment_must_be_one(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    for value in ("", "short", "not\tprintable, but long enough"):
        monkeypatch.setenv("ASIA_TEST_TOKEN", value)
        with pytest.raises(UserError, match="expected a token of at least 16"):
            serve(setting.opened(), "127.0.0.1:0", "ASIA_TEST_TOKEN")
