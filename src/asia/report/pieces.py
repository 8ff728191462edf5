"""Parts of the report page of a run, for other presentations than one file."""

from importlib import resources

from asia.report._page.code import change, python
from asia.report._page.html import Html, facts, join, said, table, tag
from asia.report._page.overlay import Overlay, draw_overlay, overlay_legend
from asia.report._page.section import Section
from asia.report._page.sections import SECTIONS
from asia.report._page.sections.accuracy import held_out_overlays
from asia.report._page.sections.experiments import experiment_story
from asia.report._page.sections.progress import progress_figure
from asia.report._page.sections.verdict import stamp
from asia.report._page.subject import Detail, Subject, result_of
from asia.report._page.svg.best import BestSoFar, draw_best
from asia.report._page.svg.progress import NARROW, WIDE

__all__ = [
    "NARROW",
    "SECTIONS",
    "WIDE",
    "BestSoFar",
    "Detail",
    "Html",
    "Overlay",
    "Section",
    "Subject",
    "change",
    "draw_best",
    "draw_overlay",
    "experiment_story",
    "facts",
    "held_out_overlays",
    "join",
    "overlay_legend",
    "page_style",
    "progress_figure",
    "python",
    "result_of",
    "said",
    "stamp",
    "table",
    "tag",
]


def page_style() -> str:
    """The style sheet of the page."""
    file = resources.files("asia").joinpath("report", "_page", "page.css")
    return file.read_text("utf-8")
