"""Coding agents as command lines. `{prompt}`, `{prompt_file}`, `{workspace}`, `{session}` and,
where there is a cap on money, `{dollars}` are filled in."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass

from asia.drive.command.stream import StreamFormat
from asia.errors import UserError

PLACEHOLDERS = ("prompt", "prompt_file", "workspace", "session", "dollars")


@dataclass(frozen=True)
class Preset:
    """Command line and stream format of a coding agent."""

    start: tuple[str, ...]
    """Template of its arguments."""
    resume: tuple[str, ...] = ()
    """The same, to take a session up again; empty where it cannot."""
    dollars: tuple[str, ...] = ()
    """Arguments that tell it its cap on money."""
    model: tuple[str, ...] = ()
    """Arguments before the name of a model."""
    format: StreamFormat = "none"
    """Format of its stream."""
    keys: tuple[str, ...] = ()
    """Environment variables that hold its credentials."""
    config: str = ""
    """Its own folder below the home directory."""
    tells_cost: bool = False
    """True if its stream reports the cost."""
    tells_late: bool = False
    """True if it reports tokens only at the end of a turn or session, so that a cap may be exceeded
    considerably.
    """


_CLAUDE = (
    "claude", "--output-format", "stream-json", "--verbose", "--permission-mode",
    "bypassPermissions", "--strict-mcp-config", "--setting-sources", "",
)  # fmt: skip
# The jail is the sandbox: Codex cannot start its own inside.
_CODEX = ("--json", "--skip-git-repo-check", "--sandbox", "danger-full-access", "-c",
          'approval_policy="never"')  # fmt: skip

PRESETS: Mapping[str, Preset] = {
    "claude": Preset(
        start=(*_CLAUDE, "-p", "{prompt}"),
        resume=(*_CLAUDE, "--resume", "{session}", "-p", "{prompt}"),
        dollars=("--max-budget-usd", "{dollars}"),
        model=("--model",),
        format="claude",
        keys=("ANTHROPIC_API_KEY",),
        config=".claude",
        tells_cost=True,
    ),
    "codex": Preset(
        start=("codex", "exec", *_CODEX, "-C", "{workspace}", "{prompt}"),
        resume=("codex", "exec", "resume", "{session}", *_CODEX, "{prompt}"),
        model=("-m",),
        format="codex",
        keys=("OPENAI_API_KEY", "CODEX_API_KEY"),
        config=".codex",
        tells_late=True,
    ),
    "gemini": Preset(
        start=("gemini", "-p", "{prompt}", "-o", "stream-json", "--approval-mode", "yolo",
               "--skip-trust"),
        model=("-m",),
        format="gemini",
        keys=("GEMINI_API_KEY",),
        config=".gemini",
        tells_late=True,
    ),
}  # fmt: skip


def make_preset(name: str, command: str | None) -> Preset:
    """A known agent, or any command: `command` is its template. Raises UserError."""
    if name in PRESETS:
        if command is not None:
            raise UserError(
                "--command requires --agent command:NAME with a NAME of your own, not the "
                f"preset '{name}'"
            )
        return PRESETS[name]
    if command is None:
        raise UserError(
            f"--agent command:{name}: there is {', '.join(PRESETS)}; for any other program give "
            "its command line with --command, with {prompt} or {prompt_file} in it"
        )
    arguments = tuple(shlex.split(command))
    if not arguments or not any("{prompt}" in w or "{prompt_file}" in w for w in arguments):
        raise UserError("--command: expected a command line with {prompt} or {prompt_file} in it")
    return Preset(start=arguments)


def filled(template: tuple[str, ...], values: Mapping[str, str]) -> list[str]:
    """The arguments with every placeholder replaced; other braces stay."""
    answer: list[str] = []
    for word in template:
        for name in PLACEHOLDERS:
            word = word.replace("{" + name + "}", values.get(name, ""))
        answer.append(word)
    return answer
