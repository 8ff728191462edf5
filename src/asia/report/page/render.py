"""Templates of pages: values are escaped, and numbers go through formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from asia._files import PACKAGE
from asia._text import one_line, printable
from asia.presentation.table import FORMATS, Block
from asia.report.drawing.inline import PANEL, WIDE, svg_of
from asia.report.page.code import python
from asia.report.page.formulas import equations

_FOLDER: Final = PACKAGE / "report" / "page" / "templates"


def _sentence(text: str, end: str = ".") -> str:
    """A text as a sentence that ends with `end`."""
    line = one_line(text, 2000)
    return f"{line[:1].upper()}{line[1:].removesuffix('.')}{end}"


@cache
def environment(*folders: Path) -> Environment:
    """Return the templates of folders and those of the report. A text is escaped and loses its
    control characters; None is an empty text; a name that a template does not receive is an
    error."""
    found = Environment(
        loader=FileSystemLoader([*folders, _FOLDER]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_finalized,
    )
    found.filters.update(FORMATS, sentence=_sentence)
    functions: dict[str, Any] = {"equations": equations, "python": python}
    found.globals.update(functions)
    return found


def _finalized(value: Any) -> Any:
    if value is None:
        return ""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def render(template: str, *folders: Path, **values: Any) -> Markup:
    """Fill a template of the report, or of other folders."""
    return Markup(environment(*folders).get_template(template).render(values))


def show(blocks: Iterable[Block]) -> Markup:
    """Write blocks one below the other; markup as it is."""
    return render("blocks.html", blocks=[*blocks])


def picture(draw: Callable[[], Figure], alt: str, width: float = WIDE) -> Markup:
    """Draw a picture, as wide as the page unless `width` in inches says otherwise; a wide one
    scrolls sideways where the page is narrow. alt: the picture in words."""
    svg = Markup(svg_of(draw, alt, width))
    return render("picture.html", svg=svg, alt=alt, is_wide=width != PANEL)


def page_style() -> str:
    """The style sheet of the pages."""
    return (PACKAGE / "report" / "page" / "page.css").read_text("utf-8")
