"""What a failure says, on one line."""

from __future__ import annotations

import re

from asia._text import one_line

_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)
