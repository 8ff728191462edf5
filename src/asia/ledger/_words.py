"""Words from outside, made fit to be shown."""

from __future__ import annotations

import re

_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')


def one_line(text: str, most: int = 300) -> str:
    """Printable characters on one line, cut to `most`; what comes from outside is shown as this."""
    flat = " ".join(text.split())
    clean = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in flat)
    return clean if len(clean) <= most else clean[: most - 1] + "…"


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)
