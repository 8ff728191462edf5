"""Report page of a run: one HTML file with everything, offline."""

from asia.report._page.bundle import PublishedRuns, write_bundle
from asia.report._page.page import LIMIT, page_of, write_page

__all__ = ["LIMIT", "PublishedRuns", "page_of", "write_bundle", "write_page"]
