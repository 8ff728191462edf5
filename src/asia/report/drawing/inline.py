"""Pictures as SVG inside HTML: colours of the page, no id that another picture has."""

import hashlib
import re
from collections.abc import Callable
from io import BytesIO
from typing import Final
from xml.etree import ElementTree

from matplotlib.figure import Figure

from asia.report.drawing.style import (
    BLUE,
    FAINT,
    GREEN,
    GRID,
    INK,
    ORANGE,
    QUIET,
    RED,
    SHADE,
    drawing,
)

WIDE: Final = 8.6
"""Width of a picture as wide as the page, in inches."""
PANEL: Final = 4.6
"""Width of one of several pictures beside each other, in inches."""

# The style sheet of the pages has a light and a dark value of each.
_VARIABLES: Final = {
    INK: "ink",
    QUIET: "quiet",
    FAINT: "measured",
    BLUE: "blue",
    ORANGE: "orange",
    GREEN: "green",
    RED: "red",
    SHADE: "line",
    GRID: "line",
    "#ffffff": "paper",
}
_COLOUR = re.compile("|".join(_VARIABLES), re.IGNORECASE)
# Ids that matplotlib counts itself; all others are a gid of ours.
_COUNTED = re.compile(r"[a-z0-9.]+_\d+", re.IGNORECASE)
_METADATA: Final = {"Date": None, "Creator": None, "Format": None, "Type": None}


def svg_of(draw: Callable[[], Figure], alt: str, width: float, *, fixed: bool = False) -> str:
    """Draw a picture as an `svg` element. A gid of an artist is the class of its group.

    Args:
        draw: draws it.
        alt: the picture in words; "" for one that says nothing new.
        width: as that of `drawing`, in inches.
        fixed: true for its size in pixels; otherwise it is as wide as its place.
    """
    stream = BytesIO()
    with drawing(width):
        figure = draw()
        figure.savefig(stream, format="svg", metadata=_METADATA)
        wide, high = 96 * figure.get_figwidth(), 96 * figure.get_figheight()
    text = stream.getvalue().decode()
    root = ElementTree.fromstring(text)
    prefix = f"p{hashlib.sha256(text.encode()).hexdigest()[:8]}-"
    ids: dict[str, str] = {}
    for name in re.findall(r'(?:url\(|xlink:href=")#([^)"]+)', text):
        ids.setdefault(name, f"{prefix}{len(ids)}")
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = _attributes(element.attrib, ids)
        # What all children have, their group says once.
        styles = {child.get("style") for child in element}
        kinds = {child.tag.rpartition("}")[2] for child in element}
        if kinds == {"use"} and len(styles) == 1 and (style := styles.pop()):
            element.set("style", _coloured(style))
            for child in element:
                del child.attrib["style"]
        if element.tail is not None:
            element.tail = None
        if element.text is not None and not element.text.strip():
            element.text = None
    # The style sheet of the pages has its only rule.
    for child in list(root):
        if child.find("style") is not None:
            root.remove(child)
    size = {"width": f"{wide:g}", "height": f"{high:g}"} if fixed else {"class": "picture"}
    if not fixed:
        size["style"] = f"max-width:{1.15 * wide:.0f}px"
    names = {"role": "img", "aria-label": alt} if alt else {"aria-hidden": "true"}
    root.attrib = {"viewBox": root.attrib["viewBox"], **size, **names}
    return ElementTree.tostring(root, encoding="unicode")


def _attributes(given: dict[str, str], ids: dict[str, str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in given.items():
        key = key.rpartition("}")[2]
        if key == "id" and value in ids:
            found["id"] = ids[value]
        elif key == "id":
            if not _COUNTED.fullmatch(value):
                found["class"] = value
        elif key == "href":
            found["href"] = f"#{ids[value[1:]]}"
        elif key == "clip-path":
            found[key] = f"url(#{ids[value[5:-1]]})"
        elif key == "style":
            found[key] = _coloured(value)
        elif key == "d":
            found[key] = re.sub(r"\s*([A-Za-z])\s*", r"\1", _rounded(value)).replace("\n", " ")
        elif key in ("x", "y"):
            found[key] = _rounded(value)
        elif key != "transform" or not value.startswith("rotate(-0 "):
            found[key] = value
    return found


def _coloured(style: str) -> str:
    style = _COLOUR.sub(lambda found: f"var(--{_VARIABLES[found[0].lower()]})", style)
    return style.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")


def _rounded(numbers: str) -> str:
    return re.sub(r"(\.\d\d)\d+", r"\1", numbers)
