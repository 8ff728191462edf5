"""Run the commands of docs/tutorial.md and rewrite the outputs that it shows: `make tutorial`."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

PAGE = Path(__file__).parents[1] / "tutorial.md"
OUTPUT = re.compile(
    r"<!-- output of `(?P<command>[^`]+)`, lines with (?P<lines>.+?) -->\n"
    r"```\n(?P<shown>.*?)```\n",
    flags=re.DOTALL,
)
"""An output of a command. A line is shown if it matches the regular expression `lines`."""
WIDTH = 126


def blocks(page: str, language: str) -> list[str]:
    """Contents of the code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)


def run_tutorial(page: str, folder: Path) -> dict[str, str]:
    """Do in `folder` all that the page says, and return what each command printed.

    The Python programs are saved under the names that the text gives them. The equations replace
    the commented ones as soon as a command mentions the run of that name.
    """
    names = re.findall(r"[Ss]ave\s+(?:the\s+program|this)\s+as\s+`([\w.]+)`", page)
    for name, program in zip(names, blocks(page, "python"), strict=True):
        (folder / name).write_text(program)
    (equations,) = blocks(page, "toml")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    printed: dict[str, str] = {}
    for block in blocks(page, "sh"):
        for command in block.splitlines():
            if "--name tank-physics" in command:
                problem = folder / "tank" / "problem.toml"
                before, commented, _ = problem.read_text().partition("\n# [physics]")
                assert commented, "problem.toml has no commented equations"
                problem.write_text(f"{before}\n{equations}")
            done = subprocess.run(
                shlex.split(command), cwd=folder, env=environment, capture_output=True, text=True
            )
            printed[command] = done.stdout + done.stderr
            if done.returncode:
                raise SystemExit(f"{command}: {printed[command]}")
    return printed


def shortened(text: str, lines: str) -> str:
    """The lines that match the regular expression; an ellipsis for each gap between them."""
    shown: list[str] = []
    for line in text.splitlines():
        if re.search(lines, line):
            cut = line if len(line) <= WIDTH else f"{line[: WIDTH - 4].rstrip()} ..."
            shown.append(cut.rstrip())
        elif shown and shown[-1] != "...":
            shown.append("...")
    if shown and shown[-1] == "...":
        shown.pop()
    return "".join(f"{line}\n" for line in shown)


def rewritten(page: str, printed: dict[str, str]) -> str:
    """The page with the outputs that its commands printed."""

    def block(found: re.Match[str]) -> str:
        text = shortened(printed[found["command"]], found["lines"])
        head = found[0][: found.start("shown") - found.start()]
        return f"{head}{text}```\n"

    return OUTPUT.sub(block, page)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="asia-tutorial-") as folder:
        page = PAGE.read_text()
        PAGE.write_text(rewritten(page, run_tutorial(page, Path(folder))))
