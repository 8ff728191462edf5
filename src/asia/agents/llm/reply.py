"""Parser of a language model's answer into a candidate with its rationale; tolerant of the form."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from asia._text import one_line
from asia.candidate import check_source
from asia.errors import CandidateError

_TEXT = 1000
_TITLE = 60
_FAMILY = 30
_LONG = ("hypothesis", "expected")
_FENCE = re.compile(r"^\s{0,3}(`{3,}|~{3,})[ \t]*(\w*)[^\n]*$")
_LABEL = re.compile(
    r"^[\s>#*_-]*(hypothesis|expected|family|title|parent)[\s*_]*[:=][\s*_]*(.*)$", re.IGNORECASE
)
_THOUGHT = re.compile(r"<think(?:ing)?>", re.IGNORECASE)
_THOUGHT_END = re.compile(r"</think(?:ing)?>", re.IGNORECASE)


@dataclass(frozen=True)
class Reply:
    """Answer with a source. `problem` describes the error of the source, "" for none."""

    source: str
    hypothesis: str
    expected: str
    family: str
    title: str
    parent: int | None
    problem: str = ""


class MalformedReplyError(Exception):
    """Error of an answer without candidate.py; the text describes the error of its form."""


def read_reply(text: str, cut: bool = False) -> Reply:
    """Parse an answer.

    Args:
        cut: whether the answer ended at its limit of tokens

    Raises:
        MalformedReplyError: when it holds no candidate
    """
    text = _without_thoughts(text)
    prose, blocks, is_open = _split(text)
    if cut or is_open:
        raise MalformedReplyError(
            "the answer ended before candidate.py was complete: be shorter"
            if cut
            else "the python block has no closing fence"
        )
    if not blocks:
        raise MalformedReplyError("the answer has no fenced python block with candidate.py")
    source, wrong = _best(blocks)
    said = dict(_labels(prose))
    hypothesis = one_line(said.get("hypothesis", ""), _TEXT) or "not said"
    family = one_line(said.get("family", "").lower(), _FAMILY).strip("`'\" ") or "custom"
    parent = re.search(r"\d+", said.get("parent", ""))
    return Reply(
        source=source,
        hypothesis=hypothesis,
        expected=one_line(said.get("expected", ""), _TEXT) or "not said",
        family=family,
        title=one_line(said.get("title", ""), _TITLE).strip("`'\" ") or family,
        parent=int(parent.group()[:9]) if parent else None,
        problem=wrong,
    )


def _without_thoughts(text: str) -> str:
    """Remove the model's thoughts in one pass: a model that repeats itself must not cost the square
    of its answer."""
    parts: list[str] = []
    at = 0
    while begin := _THOUGHT.search(text, at):
        end = _THOUGHT_END.search(text, begin.end())
        if end is None:
            break
        parts.append(text[at : begin.start()])
        at = end.end()
    return "".join((*parts, text[at:]))


def _split(text: str) -> tuple[str, list[str], bool]:
    """Text outside fences, the blocks inside, and whether the last fence is open."""
    prose: list[str] = []
    blocks: list[str] = []
    block: list[str] = []
    fence = ""
    for line in text.splitlines():
        found = _FENCE.match(line)
        if fence:
            if found and not found[2] and found[1].startswith(fence):
                blocks.append("\n".join(block) + "\n")
                fence, block = "", []
            else:
                block.append(line)
        elif found:
            fence = found[1]
        else:
            prose.append(line)
    return "\n".join(prose), blocks, bool(fence)


def _best(blocks: list[str]) -> tuple[str, str]:
    """Return the last block that can be a candidate; without one the longest, and its error."""
    for block in reversed(blocks):
        if not _wrong(block):
            return block, ""
    longest = max(blocks, key=len)
    return longest, _wrong(longest)


def _wrong(source: str) -> str:
    try:
        check_source(source)
    except CandidateError as error:
        return str(error)
    return ""


def _labels(prose: str) -> Iterator[tuple[str, str]]:
    """Label in lower case and its text; that of a hypothesis may go on over several lines."""
    label, text = "", ""
    for line in prose.splitlines():
        found = _LABEL.match(line)
        if found:
            if label:
                yield label, text
            label, text = found[1].lower(), found[2]
        elif label in _LONG:
            text = f"{text} {line}"
    if label:
        yield label, text
