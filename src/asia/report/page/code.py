"""Python source and its changes, coloured and always escaped."""

from __future__ import annotations

import difflib

from markupsafe import Markup
from pygments.lexers.python import PythonLexer
from pygments.token import Comment, Keyword, Number, Operator, String

from asia._text import printable

_LONGEST = 40_000
_CLASSES = (
    (Comment, "c"),
    (String, "s"),
    (Number, "m"),
    (Keyword, "k"),
    (Operator.Word, "k"),
)
_BLOCK = Markup('<pre tabindex="0" role="region" aria-label="{}"><code>{}</code></pre>')


def python(source: str, label: str) -> Markup:
    """Format Python source with marked keywords, strings and comments."""
    clean = printable(source)
    if len(clean) > _LONGEST:
        clean = f"{clean[:_LONGEST]}\n… cut here; asia show --source prints all of it"
    span, parts = Markup('<span class="{}">{}</span>'), list[str]()
    for token, text in PythonLexer(stripnl=False, ensurenl=False).get_tokens(clean):
        name = next((name for kind, name in _CLASSES if token in kind), None)
        parts.append(text if name is None else span.format(name, text))
    return _BLOCK.format(label, Markup("").join(parts))


def change(old: str, new: str, names: tuple[str, str], label: str) -> Markup | None:
    """The lines that differ; None where none does, or too many do."""
    before, after = printable(old).splitlines(), printable(new).splitlines()
    lines = list(difflib.unified_diff(before, after, *names, lineterm="", n=2))[2:]
    if not lines:
        return None
    kinds = {"+": "ins", "-": "del"}
    each = ((Markup(kinds.get(line[:1], "span")), line) for line in lines)
    text = Markup("\n").join(Markup("<{0}>{1}</{0}>").format(kind, line) for kind, line in each)
    return None if len(text) > _LONGEST else _BLOCK.format(label, text)
