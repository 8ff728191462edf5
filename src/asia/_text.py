"""Text from outside made safe to show, and suggestions for misspelt names."""

import math
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable
from difflib import get_close_matches
from typing import TextIO

# Words from outside, made fit to be shown: on a terminal, on one line, in Markdown.
#
# From outside is what ASIA did not write itself: candidates and what they print, agents, notes,
# names of files, records and signals. Terminals obey control characters, so none of these gets
# there.


# Special characters of a line of Markdown: escapes, emphasis, code, links, HTML and its names of
# characters, columns, deletions, mentions; an underscore inside a word is none of these.
_MARKED = re.compile(r"[\\`*\[\]<>|~@&]|(?<![^\W_])_|_(?![^\W_])")
# Addresses that many programs turn into links by themselves.
_ADDRESS = re.compile(r"(?i)\b(https?|ftp|mailto|xmpp)(:)|\b(www)(\.)")


def printable(text: str) -> str:
    """Several lines: control characters other than newline and tab are left out."""
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(c for c in text if c in "\n\t" or c.isprintable())


def printable_line(text: str) -> str:
    """Return a text on one line: spaces for line breaks, a mark for other control characters."""
    replaced = {"\n": " ", "\t": " ", "\r": " "}
    return "".join(
        c if c.isprintable() else replaced.get(c, "\N{REPLACEMENT CHARACTER}") for c in text
    )


def table_cell(text: str) -> str:
    """Return one cell of a tab-separated table. A text that a spreadsheet would read as a formula
    gets an apostrophe; a number stays one."""
    line = printable_line(text)
    if not line.lstrip().startswith(("=", "+", "-", "@")):
        return line
    try:
        float(line)
    except ValueError:
        return f"'{line}"
    return line


def one_line(text: str, most: int = 300) -> str:
    """Printable characters on one line, cut to `most`."""
    clean = printable_line(" ".join(text.split()))
    return clean if len(clean) <= most else clean[: most - 1] + "…"


def markdown_line(text: str) -> str:
    """Return one line that Markdown shows literally: no heading, link, column, HTML or emphasis."""
    line = _MARKED.sub(r"\\\g<0>", printable_line(" ".join(text.split())))
    return _ADDRESS.sub(r"\1\3\\\2\4", line)


_LABEL = re.compile(r"( *\S.{0,13}?  +)\S")


def folded(text: str, width: int) -> str:
    """Fold one line between words at a width. Padding is taken out, and the further lines are
    indented below the text behind a label."""
    if len(text) <= width:
        return text
    label = _LABEL.match(text)
    indent = len(label[1]) if label else len(text) - len(text.lstrip()) + 2
    head, rest = (text[:indent], text[indent:]) if label else ("", text.rstrip())
    rest = re.sub(r"(?<=\S) {3,}", "  ", rest)
    return textwrap.fill(
        head + rest,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def say(text: str = "", *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print one line, folded between words on a terminal. `file`: standard output without one."""
    out, line = file or sys.stdout, printable_line(text)
    if out.isatty():
        line = folded(line, shutil.get_terminal_size().columns)
    print(line, file=out, flush=flush)


def say_lines(text: str, *, end: str = "\n", file: TextIO | None = None) -> None:
    """Print several lines."""
    print(printable(text), end=end, file=file or sys.stdout)


def hand_over(text: str) -> None:
    """Give a text to whatever reads standard output: unchanged to a file or a program, printable to
    a terminal."""
    sys.stdout.write(printable(text) if sys.stdout.isatty() else text)


# Suggestions for misspelt names ("did you mean").


def suggestion(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest known name, else nothing."""
    names = {name.casefold(): name for name in known if name}
    close = get_close_matches(word.casefold(), names, n=1, cutoff=0.5)
    return f"; did you mean '{names[close[0]]}'?" if close else ""


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest known name, else the list of what is known."""
    names = [name for name in known if name]
    close = suggestion(word, names)
    return close or (f"; known: {', '.join(names)}" if names else "")


# Figures that a candidate can influence, rounded for agents.


def coarse(value: float) -> float:
    """A measured time or size in steps of 10 %, with two significant digits; below 0.1 it is 0.1,
    and 0 stays 0. A figure between 0.1 and 1000 carries 7 bits at most."""
    if not value > 0:
        return 0.0
    step = round(math.log(max(value, 0.1)) / math.log(1.1))
    return rounded(1.1**step, 2)


def rounded(value: float, digits: int) -> float:
    """The value with so many significant digits."""
    return float(f"{value:.{digits}g}")
