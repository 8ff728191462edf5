"""Text for a prompt: bounded, and where it comes from a candidate, visibly data."""

from __future__ import annotations

import json
import re

from asia._text import one_line


def quoted(text: str, most: int) -> str:
    """One line in quotation marks, those inside escaped: it cannot be taken for our own words."""
    return json.dumps(one_line(text, most), ensure_ascii=False)


def bounded(text: str, most: int) -> str:
    """Cut a text of the user to `most` characters, with a remark about it."""
    text = text.strip()
    return text if len(text) <= most else f"{text[:most]}\n[cut after {most} characters]"


def fenced(source: str, most: int) -> str:
    """A source between fences that nothing inside it can close."""
    longest = max((len(run) for run in re.findall("`+", source)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}python\n{bounded(source, most)}\n{fence}"
