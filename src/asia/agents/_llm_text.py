"""Text for a prompt: bounded, and where it comes from a candidate, visibly data."""

from __future__ import annotations

import json
import re

_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')


def one_line(text: str, most: int) -> str:
    """Printable characters on one line, cut to `most`."""
    flat = " ".join(text.split())
    clean = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in flat)
    return clean if len(clean) <= most else clean[: most - 1] + "…"


def quoted(text: str, most: int) -> str:
    """One line in quotation marks, those inside escaped: it cannot be taken for our own words."""
    return json.dumps(one_line(text, most), ensure_ascii=False)


def bounded(text: str, most: int) -> str:
    """A person's text, of several lines; cut to `most` characters, with a word about it."""
    text = text.strip()
    return text if len(text) <= most else f"{text[:most]}\n[cut after {most} characters]"


def fenced(source: str, most: int) -> str:
    """A source between fences that nothing inside it can close."""
    longest = max((len(run) for run in re.findall("`+", source)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}python\n{bounded(source, most)}\n{fence}"


def error_line(error: str, most: int) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)
