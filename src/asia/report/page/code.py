"""Python source and its changes, coloured and always escaped."""

from __future__ import annotations

import difflib

from pygments.lexers.python import PythonLexer
from pygments.token import Comment, Keyword, Number, Operator, String

from asia._text import printable
from asia.report.page.html import Html, join, region, tag

_LONGEST = 40_000
_CLASSES = (
    (Comment, "c"),
    (String, "s"),
    (Number, "m"),
    (Keyword, "k"),
    (Operator.Word, "k"),
)


def python(source: str, label: str) -> Html:
    """Format Python source with marked keywords, strings and comments."""
    clean = printable(source)
    if len(clean) > _LONGEST:
        clean = f"{clean[:_LONGEST]}\n… cut here; asia show --source prints all of it"
    parts: list[str] = []
    for token, text in PythonLexer(stripnl=False, ensurenl=False).get_tokens(clean):
        name = next((name for kind, name in _CLASSES if token in kind), None)
        parts.append(text if name is None else tag("span", text, class_=name))
    return region("pre", tag("code", join(parts)), label=label)


def change(old: str, new: str, names: tuple[str, str], label: str) -> Html | None:
    """The lines that differ; None where none does, or too many do."""
    before, after = printable(old).splitlines(), printable(new).splitlines()
    lines = list(difflib.unified_diff(before, after, *names, lineterm="", n=2))[2:]
    if not lines:
        return None
    kinds = {"+": "ins", "-": "del"}
    text = join((tag(kinds.get(line[:1], "span"), line) for line in lines), "\n")
    return None if len(text) > _LONGEST else region("pre", tag("code", text), label=label)
