"""Replies of a language model, parsed into candidates, and statistics of a search."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from asia._text import one_line
from asia.agents.llm.client import read_answer
from asia.agents.llm.prompt import NO_CANDIDATE
from asia.candidate import check_source
from asia.errors import CandidateError
from asia.ledger.events import Exchanged
from asia.ledger.run import Run
from asia.ledger.view import Experiment

# Parser of a language model's answer into a candidate with its rationale; tolerant of the form.


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


# Report on a language model in a search: contract violations and cost.


LlmVerdict = Literal["able", "able with repairs", "not able"]

_WRONG = 200


@dataclass(frozen=True)
class LlmReport:
    """Statistics of the model of a search, read from its ledger."""

    model: str
    """Name of the model at its server."""
    base_url: str
    """Address of the server."""
    steps: int
    """Requested candidates."""
    answers: int
    """Number of answers."""
    at_once: int
    """Steps with a usable first answer."""
    repaired: int
    """Steps in which the form of an answer was corrected."""
    without_candidate: int
    """Steps without a candidate after all repairs."""
    scored: int
    """Candidates with a score."""
    wrong: tuple[str, ...]
    """Errors of answers, the most frequent first."""
    failures: tuple[str, ...]
    """Reasons of failed candidates, the most frequent first."""
    baseline: float | None
    """V of the baseline."""
    best: float | None
    """The lowest V of the model's candidates; None without a score."""
    prompt_tokens: int
    """Tokens of the longest request; 0 where the server does not count."""
    reply_tokens: int
    """Tokens of the longest reply; 0 where the server does not count."""
    tokens_a_step: float
    """Input and output tokens a step, repairs included."""

    @property
    def verdict(self) -> LlmVerdict:
        """Verdict: `able` if every first answer could be used and most candidates had a score; `not
        able` if a step gave no candidate or most candidates had no score."""
        enough = self.steps > 0 and 2 * self.scored >= self.steps
        if not enough or self.without_candidate:
            return "not able"
        return "able" if self.at_once == self.steps else "able with repairs"


def llm_report(run: Run) -> LlmReport:
    """The report on a run of the agent `llm`, finished or not."""
    view = run.view
    steps = [e for e in view.finished if e.proposed.phase != "baseline"]
    answered = [e for e in view.exchanges if 200 <= e.status < 300]
    objections = [(e.experiment, _objection(run, e)) for e in answered]
    count = Counter(number for number, _ in objections)
    wrong = Counter(words for _, words in objections if words)
    at_once = [s for s in steps if count[s.number] == 1 and s.proposed.family != NO_CANDIDATE]
    lost = [s for s in steps if s.proposed.family == NO_CANDIDATE]
    failures = Counter(s.failure.reason.value for s in steps if s.failure is not None)
    used = [e.usage for e in answered if e.usage is not None]
    settings = view.started.agent_settings
    return LlmReport(
        model=settings.get("model", ""),
        base_url=settings.get("base_url", ""),
        steps=len(steps),
        answers=len(answered),
        at_once=len(at_once),
        repaired=len(steps) - len(at_once) - len(lost),
        without_candidate=len(lost),
        scored=sum(s.score is not None for s in steps),
        wrong=_counted(wrong),
        failures=_counted(failures),
        baseline=_best_in_search([e for e in view.finished if e.proposed.phase == "baseline"]),
        best=_best_in_search(steps),
        prompt_tokens=max((u.input_tokens for u in used), default=0),
        reply_tokens=max((u.output_tokens for u in used), default=0),
        tokens_a_step=sum(u.tokens for u in used) / len(steps) if steps else 0.0,
    )


def _objection(run: Run, exchange: Exchanged) -> str:
    """Describe the error of an answer; "" for none."""
    answer = read_answer(run.store.get(exchange.response))
    try:
        reply = read_reply(answer.text, answer.cut)
    except MalformedReplyError as error:
        return str(error)
    return one_line(reply.problem, _WRONG)


def _counted(found: Counter[str]) -> tuple[str, ...]:
    return tuple(f"{words} ({count} times)" for words, count in found.most_common())


def _best_in_search(experiments: list[Experiment]) -> float | None:
    return min((e.score.value for e in experiments if e.score is not None), default=None)
