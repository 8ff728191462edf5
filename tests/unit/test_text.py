"""Words from outside, and the one place through which they reach a terminal."""

import ast
import re
from pathlib import Path

import pytest

import asia
from asia._text import (
    coarse,
    folded,
    markdown_line,
    one_line,
    printable,
    printable_line,
    table_cell,
)

PACKAGE = Path(asia.__file__).parent
# Escape sequences of seven and of eight bits, a bell, a backspace, text written from right to left.
HOSTILE = "a\x1b]0;b\x07c\x9b2Jd\x08e\u202ef\r\ng\rh\ti"


def test_no_control_character_is_printable() -> None:
    assert printable(HOSTILE) == "a]0;bc2Jdef\ng\nh\ti"
    mark = "\N{REPLACEMENT CHARACTER}"
    assert printable_line(HOSTILE) == f"a{mark}]0;b{mark}c{mark}2Jd{mark}e{mark}f  g h i"
    assert one_line(" a \n b\tc ") == "a b c"
    assert one_line("a" * 400, 10) == "a" * 9 + "…"
    assert printable("\ud800") == ""
    for shown in (printable(HOSTILE), printable_line(HOSTILE), one_line(HOSTILE)):
        assert all(c in "\n\t" or c.isprintable() for c in shown)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("one more lag, n_x = 3, 87 %", "one more lag, n_x = 3, 87 %"),
        ("a\n## Experiment 9\n- **V** = 0", r"a ## Experiment 9 - \*\*V\*\* = 0"),
        ("[here](http://x.y)", r"\[here\](http\://x.y)"),
        ("![](x)<img src=x onerror=y>", r"!\[\](x)\<img src=x onerror=y\>"),
        ("www.x.y HTTPS://x.y a@b.c mailto:x", r"www\.x.y HTTPS\://x.y a\@b.c mailto\:x"),
        ("`a` | b ~~c~~ _d_ \\ &lt;", r"\`a\` \| b \~\~c\~\~ \_d\_ \\ \&lt;"),
        ("\x1b[2J", "\N{REPLACEMENT CHARACTER}" + r"\[2J"),
    ],
)
def test_markdown_shows_a_line_as_it_is(text: str, shown: str) -> None:
    line = markdown_line(text)
    assert line == shown
    # What stands behind a backslash is a character and nothing else.
    assert not re.search(r"[`*\[\]<>|~@&]", re.sub(r"\\.", "", line))


@pytest.mark.slow
def test_nothing_is_written_past_the_one_place() -> None:
    """Terminals are written to by `asia._text` and by the console that takes all for plain text."""
    own = {PACKAGE / "_text.py", PACKAGE / "interfaces" / "cli" / "text.py"}
    past: list[str] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE)
        # Templates run elsewhere.
        if path in own or place.parts[0] == "problems" or place.name == "child.py":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and _writes(ast.unparse(node.func)):
                past.append(f"{place}:{node.lineno}: {ast.unparse(node.func)}")
    assert past == []


def _writes(function: str) -> bool:
    names = ("print", "Console", "rich.print", "typer.echo", "typer.secho", "click.echo", "pprint")
    return function in names or function.startswith(("sys.stdout.wr", "sys.stderr.wr"))


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("=HYPERLINK(1)", "'=HYPERLINK(1)"),
        ("+1 state", "'+1 state"),
        ("-x: other sign", "'-x: other sign"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1+1", "' =1+1"),
        ("-0.25", "-0.25"),
        ("+1e3", "+1e3"),
        ("order 2 = 3", "order 2 = 3"),
    ],
)
def test_a_cell_of_a_table_is_no_formula(text: str, cell: str) -> None:
    assert table_cell(text) == cell


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 0.0), (-1.0, 0.0), (0.003, 0.1), (1.0, 1.0), (2.5, 2.6), (1400, 1400)],
)
def test_coarse_figures(value: float, expected: float) -> None:
    assert coarse(value) == expected


def test_coarse_figures_are_few_and_near() -> None:
    values = [0.1 * 1.003**k for k in range(3000)]
    assert len({coarse(v) for v in values if v <= 1000}) < 2**7
    assert all(abs(coarse(v) - v) <= 0.1 * v for v in values)


def test_a_long_line_is_folded_between_words_below_its_label() -> None:
    line = (
        "use     refit: It fits the training records as well as the ensemble does (error 0.0166)."
    )
    lines = folded(line, 60).split("\n")
    assert all(len(one) <= 60 for one in lines)
    assert all(one.startswith(" " * 8) for one in lines[1:])
    assert " ".join(" ".join(lines).split()) == " ".join(line.split())


def test_padding_is_taken_out_where_a_line_is_folded_and_paths_stay_whole() -> None:
    padded = f"#01 keep    V=0.1192  {'baseline':<60} | best #01 0.1192"
    assert folded(padded, 80) == "#01 keep    V=0.1192  baseline  | best #01 0.1192"
    assert folded(padded, 200) == padded
    path = "/a" * 60
    assert path in folded(f"wrote    {path}", 80)
