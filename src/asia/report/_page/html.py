"""HTML as values: what is not HTML already is escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from asia._text import one_line, printable

_VOID = frozenset({"meta", "br", "line", "path", "circle", "rect"})


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, /, *children: str | None, **attributes: object) -> Html:
    """Write an element. Children that are not `Html` are escaped, None is left out. Attributes:
    `class_` is class, `data_from` is data-from, True has no value, None and False are left out.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        plain = key.rstrip("_").replace("_", "-")
        words.append(plain if value is True else f'{plain}="{escape(printable(str(value)))}"')
    opening = f"<{' '.join(words)}>"
    if name in _VOID:
        return Html(opening if name in ("meta", "br") else f"{opening[:-1]}/>")
    return Html(f"{opening}{join(children)}</{name}>")


def join(parts: Iterable[str | None], between: str = "") -> Html:
    """Concatenate parts; None is left out."""
    return Html(text(between).join(text(part) for part in parts if part is not None))


def text(part: str) -> Html:
    """The same, escaped unless it is `Html`."""
    return part if isinstance(part, Html) else Html(escape(printable(part), quote=False))


def said(words: str, most: int = 300) -> Html:
    """Quote a foreign text on one line: a name, a title, a text of an agent. The audit ignores its
    numbers.
    """
    return tag("span", one_line(words, most), class_="said")


def fixed(words: str) -> Html:
    """A number that belongs to the method, such as the level of an interval, and not to a
    result."""
    return tag("span", words, class_="fixed")


def table(head: Iterable[str], rows: Iterable[Iterable[str | None]], caption: str) -> Html:
    """A table that scrolls sideways where the page is narrow. The first column names the rows."""
    headings = [tag("th", cell, scope="col") for cell in head]
    body: list[Html] = []
    for row in rows:
        first, *others = ("" if cell is None else cell for cell in row)
        cells = [tag("th", first, scope="row"), *(tag("td", cell) for cell in others)]
        body.append(tag("tr", *cells))
    inner = tag(
        "table",
        tag("caption", said(caption)),
        tag("thead", tag("tr", *headings)),
        tag("tbody", *body),
    )
    return tag("div", inner, class_="scroll", tabindex="0", role="region", aria_label=caption)


def facts(pairs: Iterable[tuple[str, str | None]]) -> Html:
    """Names and what they are; pairs with None are left out."""
    found = [join((tag("dt", k), tag("dd", v))) for k, v in pairs if v is not None]
    return tag("dl", *found, class_="facts")
