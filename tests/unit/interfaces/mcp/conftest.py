from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from asia.interfaces.mcp import Opened, open_search
from tests.unit.interfaces.workspace.desks import end_searches, order
from tests.unit.search.toy import arx, write_problem

SLOW = arx(3).replace("n = 3\n    rows", "__import__('time').sleep(1.5)\n    n = 3\n    rows")


@dataclass(frozen=True)
class Agent:
    """Calls of the tools by a coding agent."""

    client: Client

    async def call(self, tool: str, **arguments: object) -> dict[str, Any]:
        """The structured answer of a call that succeeds."""
        result = await self.client.call_tool(f"asia_{tool}", arguments)
        assert not result.is_error, result.content
        assert result.structured_content is not None
        if tool != "problem":
            said = json.loads(result.content[0].text)  # pyright: ignore
            assert said == result.structured_content
        return result.structured_content

    async def refused(self, tool: str, **arguments: object) -> str:
        """Return the message of a call that fails."""
        result = await self.client.call_tool(f"asia_{tool}", arguments)
        assert result.is_error
        return result.content[0].text  # pyright: ignore

    async def submit(self, code: str, **words: object) -> str:
        """The ticket."""
        said = {"hypothesis": "it helps", "expected": "a lower V", **words}
        return (await self.call("submit", code=code, **said))["ticket"]

    async def judged(self, ticket: str) -> dict[str, Any]:
        """Its result, waited for as long as it takes."""
        while (answer := await self.call("wait", ticket=ticket))["state"] != "done":
            pass
        return answer["result"]

    async def text(self, uri: str) -> str:
        """A resource."""
        read = await self.client.read_resource(uri)
        return read.contents[0].text  # pyright: ignore


@dataclass(frozen=True)
class Setting:
    """A problem on the disk, and where its runs go."""

    problem: Path
    runs: Path

    @property
    def directory(self) -> Path:
        return self.runs / "toy-mcp-s0"

    def opened(self, experiments: int | None = 4) -> Opened:
        return open_search(order(self.problem, experiments), self.runs, None)


@pytest.fixture
def setting(tmp_path: Path) -> Iterator[Setting]:
    made = Setting(write_problem(tmp_path / "toy", experiments=4), tmp_path / "runs")
    yield made
    end_searches(made.directory)
