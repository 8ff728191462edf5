"""The check of a page against its ledger, before it is written.

The audit shares nothing with the sections: it reads the finished page and the bytes of the ledger.
"""

from __future__ import annotations

import json
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from asia.errors import InternalError, UserError
from asia.ledger import Store
from asia.report._page.numbers import FORMS, ONE, RULES, follow

_FREE = frozenset({"code", "pre", "svg", "math", "style", "title", "kbd"})
_FREE_CLASSES = frozenset({"said", "fixed", "scale"})
_VOID = frozenset({"meta", "br", "hr", "img", "input", "link", "wbr"})
_DIGIT = re.compile(r"\d")
_SHA = re.compile(r"[0-9a-f]{64}")


def audit(page: str, directory: Path, events: int) -> int:
    """Check every number of a page against the ledger.

    Args:
        page: the HTML page.
        directory: run directory.
        events: number of events of the ledger that the page covers.

    Returns:
        The number of checked numbers.

    Raises:
        InternalError: a number differs from the ledger or names no source; the message names the
            first one.
    """
    reader = _Reader(_Sources(directory, events))
    reader.feed(page)
    reader.close()
    return reader.checked


class _Sources:
    """The values that a page may name."""

    def __init__(self, directory: Path, events: int) -> None:
        lines = (directory / "ledger.jsonl").read_bytes().split(b"\n")
        self._events: list[dict[str, Any]] = [json.loads(line) for line in lines[:events]]
        self._directory = directory
        self._named = "\n".join(map(str, self._events))
        self._lock: dict[str, Any] | None = None

    def values(self, sources: str) -> list[Any]:
        """Return the values of all sources, in order."""
        found: list[Any] = []
        for one in sources.split(" "):
            name, _, path = one.partition(":")
            for document in self._documents(name):
                found += follow(document, path)
        return found

    def _documents(self, name: str) -> list[Any]:
        if name.isdecimal():
            return [self._events[int(name)]]
        if name == "lock":
            return [self._read_lock()]
        if _SHA.fullmatch(name):
            if name not in self._named:
                raise KeyError(f"no event names the artifact {name}")
            return [json.loads(Store(self._directory / "artifacts").get(name))]
        return [event for event in self._events if event["event"] == name]

    def _read_lock(self) -> dict[str, Any]:
        if self._lock is None:
            text = (self._directory / "problem.lock.toml").read_text("utf-8")
            self._lock = tomllib.loads(text)
        return self._lock


class _Reader(HTMLParser):
    """Parser of the page. A text with a digit must be in a checked element, or in one that is
    quoted, code, or drawn.
    """

    def __init__(self, sources: _Sources) -> None:
        super().__init__(convert_charrefs=True)
        self.checked = 0
        self._sources = sources
        self._open: list[tuple[str, bool]] = []
        self._number: dict[str, str] | None = None
        self._shown = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attrs}
        if tag in _VOID:
            return
        free = tag in _FREE or bool(_FREE_CLASSES & set(found.get("class", "").split()))
        self._open.append((tag, free or self._free))
        if "data-from" in found:
            self._number, self._shown = found, ""

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if "data-from" in found:
            raise InternalError(f"report: <{tag}> names {found['data-from']} and shows no number")

    def handle_data(self, data: str) -> None:
        if self._number is not None:
            self._shown += data
        elif _DIGIT.search(data) and not self._free:
            line = " ".join(data.split())[:80]
            raise InternalError(f"report: a number without a source in '{line}'")

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open[-1][0] != tag:
            raise InternalError(f"report: </{tag}> closes nothing")
        self._open.pop()
        if self._number is not None:
            self._check(self._number, self._shown)
            self._number = None

    @property
    def _free(self) -> bool:
        return bool(self._open) and self._open[-1][1]

    def _check(self, number: dict[str, str], shown: str) -> None:
        sources, rule = number["data-from"], number.get("data-rule", ONE)
        try:
            result = RULES[rule](self._sources.values(sources))
            expected = FORMS[number["data-as"]](result)
        except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, UserError) as error:
            raise InternalError(
                f"report: the number {shown} names {sources}, where none is: {error!r}"
            ) from error
        if shown != expected or number.get("value") != str(result):
            raise InternalError(
                f"report: the page says {shown} where the ledger, {sources} ({rule}), says "
                f"{expected}"
            )
        self.checked += 1
