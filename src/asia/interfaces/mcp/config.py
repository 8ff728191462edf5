"""Configuration of the clients that start `asia agent mcp`, each in its own file format."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

CLIENTS = ("claude", "codex", "gemini")
START_SECONDS = 60
CALL_SECONDS = 120
_TASK = "Call asia_problem, then search as it says until the budget is spent"


@dataclass(frozen=True)
class ClientConfiguration:
    """`text` is the file, or a part of it; `notes` say where it goes and what else matters."""

    text: str
    notes: tuple[str, ...]


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
    command, words = str(script), ["agent", "mcp", *arguments]
    if not script.is_file():
        command = sys.executable
        words = ["-m", "asia", *words]
    if client == "codex":
        lines = [
            "[mcp_servers.asia]",
            f"command = {json.dumps(command)}",
            f"args = {json.dumps(words)}",
            f"startup_timeout_sec = {START_SECONDS}",
            f"tool_timeout_sec = {CALL_SECONDS}",
            "# Without this line codex exec cancels every call.",
            'default_tools_approval_mode = "approve"',
        ]
        if environment:
            lines += ["", "[mcp_servers.asia.env]"]
            lines += [f"{k} = {json.dumps(v)}" for k, v in environment.items()]
        return ClientConfiguration(
            "\n".join(lines) + "\n",
            (
                "Codex: add this to ~/.codex/config.toml",
                f'headless: codex exec --skip-git-repo-check "{_TASK}"',
            ),
        )
    server: dict[str, object] = {"command": command, "args": words}
    if environment:
        server["env"] = dict(environment)
    server["timeout"] = CALL_SECONDS * 1000
    if client == "claude":
        server = {"type": "stdio", **server}
        notes = (
            "Claude Code: save this as .mcp.json in the folder you start claude in (it asks once "
            "whether to trust it)",
            f'headless: claude -p "{_TASK}" --mcp-config .mcp.json --strict-mcp-config '
            '--allowedTools "mcp__asia__*"',
            "without questions in a session: settings.json, permissions.allow: "
            '["mcp__asia__*"]; start with /mcp__asia__asia_search',
        )
    else:
        server["trust"] = True
        notes = (
            "Gemini CLI: merge this into .gemini/settings.json of the folder, or of your home",
            "trust lets it call the tools without asking; headless runs refuse them otherwise",
            f'headless: gemini -p "{_TASK}" --skip-trust --allowed-mcp-server-names asia',
        )
    text = json.dumps({"mcpServers": {"asia": server}}, indent=2, ensure_ascii=False) + "\n"
    return ClientConfiguration(text, notes)
