"""Python source and its changes, coloured and always escaped."""

from __future__ import annotations

import difflib
import io
import keyword
import tokenize

from asia._text import printable
from asia.report._page.html import Html, join, tag

_LONGEST = 40_000


def python(source: str, label: str) -> Html:
    """A source with keywords, strings and comments told apart."""
    clean = printable(source)
    if len(clean) > _LONGEST:
        clean = f"{clean[:_LONGEST]}\n… cut here; asia show --source prints all of it"
    return _block(tag("code", _coloured(clean)), label)


def change(old: str, new: str, names: tuple[str, str], label: str) -> Html | None:
    """The lines that differ; None where none does."""
    before, after = printable(old).splitlines(), printable(new).splitlines()
    lines = list(difflib.unified_diff(before, after, *names, lineterm="", n=2))[2:]
    if not lines:
        return None
    kinds = {"+": "ins", "-": "del"}
    shown = [tag(kinds.get(line[:1], "span"), line) for line in lines]
    text = join(shown, "\n")
    if len(text) > _LONGEST:
        return None
    return _block(tag("code", text), label)


def _block(inner: Html, label: str) -> Html:
    return tag("pre", inner, tabindex="0", role="region", aria_label=label)


def _coloured(source: str) -> Html:
    """As it stands where it is not Python."""
    lines = source.splitlines(keepends=True)
    offsets = [0]
    for line in lines:
        offsets.append(offsets[-1] + len(line))
    parts: list[str] = []
    done = 0
    try:
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            name = _kind(token)
            if name is None:
                continue
            start = offsets[token.start[0] - 1] + token.start[1]
            end = offsets[token.end[0] - 1] + token.end[1]
            parts += [source[done:start], tag("span", source[start:end], class_=name)]
            done = end
    except (tokenize.TokenError, SyntaxError, IndexError):
        return join([source])
    return join([*parts, source[done:]])


def _kind(token: tokenize.TokenInfo) -> str | None:
    if token.type == tokenize.COMMENT:
        return "c"
    if token.type == tokenize.STRING:
        return "s"
    if token.type == tokenize.NUMBER:
        return "m"
    if token.type == tokenize.NAME and keyword.iskeyword(token.string):
        return "k"
    return None
