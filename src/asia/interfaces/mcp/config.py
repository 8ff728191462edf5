"""Configuration of the clients that start `asia agent mcp`, each in its own file format."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

START_SECONDS = 60
CALL_SECONDS = 120
_TASK = "Call asia_problem, then search as it says until the budget is spent"
_RUN = "from asia.interfaces.cli import main; main()"


@dataclass(frozen=True)
class ClientConfiguration:
    """`text` is the file, or a part of it; `notes` say where it goes and what else matters."""

    text: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Command:
    executable: str
    arguments: tuple[str, ...]
    environment: Mapping[str, str]


def client_configuration(
    client: str, arguments: Sequence[str], environment: Mapping[str, str]
) -> ClientConfiguration:
    """Return the configuration for a client of `CLIENTS`.

    Args:
        client: name of the client.
        arguments: arguments of `asia agent mcp`, with absolute paths.
        environment: variables that the server needs, because clients pass on few of their own.
    """
    script = Path(sys.executable).parent / "asia"
    if script.is_file():
        command = _Command(str(script), ("agent", "mcp", *arguments), environment)
    else:
        command = _Command(sys.executable, ("-c", _RUN, "agent", "mcp", *arguments), environment)
    return _CLIENTS[client](command)


def _claude(command: _Command) -> ClientConfiguration:
    server = {"type": "stdio", **_server(command), "timeout": CALL_SECONDS * 1000}
    return ClientConfiguration(
        _json({"mcpServers": {"asia": server}}),
        (
            "Claude Code: save this as .mcp.json in the folder you start claude in (it asks once "
            "whether to trust it)",
            f'headless: claude -p "{_TASK}" --mcp-config .mcp.json --strict-mcp-config '
            '--allowedTools "mcp__asia__*"',
            "without questions in a session: settings.json, permissions.allow: "
            '["mcp__asia__*"]; start with /mcp__asia__asia_search',
        ),
    )


def _codex(command: _Command) -> ClientConfiguration:
    lines = [
        "[mcp_servers.asia]",
        f"command = {json.dumps(command.executable)}",
        f"args = {json.dumps(list(command.arguments))}",
        f"startup_timeout_sec = {START_SECONDS}",
        f"tool_timeout_sec = {CALL_SECONDS}",
        "# Without this line codex exec cancels every call.",
        'default_tools_approval_mode = "approve"',
    ]
    if command.environment:
        lines += ["", "[mcp_servers.asia.env]"]
        lines += [f"{k} = {json.dumps(v)}" for k, v in command.environment.items()]
    return ClientConfiguration(
        "\n".join(lines) + "\n",
        (
            "Codex: add this to ~/.codex/config.toml",
            f'headless: codex exec --skip-git-repo-check "{_TASK}"',
        ),
    )


def _gemini(command: _Command) -> ClientConfiguration:
    server = {**_server(command), "timeout": CALL_SECONDS * 1000, "trust": True}
    return ClientConfiguration(
        _json({"mcpServers": {"asia": server}}),
        (
            "Gemini CLI: merge this into .gemini/settings.json of the folder, or of your home",
            "trust lets it call the tools without asking; headless runs refuse them otherwise",
            f'headless: gemini -p "{_TASK}" --skip-trust --allowed-mcp-server-names asia',
        ),
    )


def _server(command: _Command) -> dict[str, object]:
    server: dict[str, object] = {"command": command.executable, "args": list(command.arguments)}
    return {**server, "env": dict(command.environment)} if command.environment else server


def _json(table: Mapping[str, object]) -> str:
    return json.dumps(table, indent=2, ensure_ascii=False) + "\n"


_CLIENTS: dict[str, Callable[[_Command], ClientConfiguration]] = {
    "claude": _claude,
    "codex": _codex,
    "gemini": _gemini,
}
CLIENTS = tuple(_CLIENTS)
