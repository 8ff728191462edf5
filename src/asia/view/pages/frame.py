"""Frame of all pages: head, link back, state of the connection."""

from __future__ import annotations

import re
from collections.abc import Sequence
from urllib.parse import quote

from asia.report.pieces import Html, tag

_ANCHOR = re.compile(r'href="#e(\d+)"')


def run_address(name: str) -> str:
    """The path of a run's page."""
    return f"/runs/{quote(name, safe='')}"


def whole_page(
    title: str, trail: Sequence[tuple[str, str]], main: Sequence[Html | None], token: str
) -> str:
    """A whole page. trail: names and addresses of the pages above it."""
    links = [tag("a", text, href=address) for text, address in trail]
    crumbs = tag("nav", *links, class_="trail", aria_label="Breadcrumb")
    connection = tag("p", "", id="connection", role="status")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="asia-token", content=token),
        tag("title", f"{title} · ASIA"),
        Html('<link rel="icon" href="/static/icon.svg">'),
        Html('<link rel="stylesheet" href="/static/page.css">'),
        Html('<link rel="stylesheet" href="/static/view.css">'),
        Html('<script src="/static/view.js" defer></script>'),
        Html('<script src="/static/zoom.js" defer></script>'),
    )
    body = tag(
        "body",
        tag("a", "Skip to the content", href="#main", class_="skiplink"),
        tag("div", crumbs, connection, class_="bar-top"),
        tag("main", *main, id="main", tabindex="-1"),
        tag("div", id="live", class_="unseen", aria_live="polite"),
    )
    return f"<!doctype html>\n{tag('html', head, body, lang='en')}\n"


def section(key: str, title: str, *inner: Html | None) -> Html | None:
    """A part of a page with its heading; None without anything in it."""
    if all(part is None for part in inner):
        return None
    heading = f"h-{key}"
    return tag("section", tag("h2", title, id=heading), *inner, id=key, aria_labelledby=heading)


def to_pages(html: Html, name: str) -> Html:
    """Links to experiments lead to their pages."""
    return Html(_ANCHOR.sub(rf'href="{run_address(name)}/experiments/\1"', html))
