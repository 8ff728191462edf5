"""Replies of a language model, parsed into candidates, and statistics of a search."""

import json
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

from asia._text import one_line
from asia.agents.llm.prompt import NO_CANDIDATE
from asia.candidate import check_source
from asia.errors import CandidateError
from asia.ledger.run import Run
from asia.ledger.view import Experiment


@dataclass(frozen=True)
class Answer:
    """Answer of the model.

    Attributes:
        cut: whether it ended at the limit of tokens
    """

    text: str
    cut: bool = False


def read_answer(content: bytes) -> Answer:
    """The text of a chat completion; "" where it has none."""
    choices = json_object(content).get("choices")
    choice = json_object(choices[0]) if isinstance(choices, list) and choices else {}
    text = json_object(choice.get("message")).get("content")
    said = text if isinstance(text, str) else ""
    # Half a surrogate pair could not be sent back.
    clean = said.encode("utf-8", "replace").decode()
    return Answer(clean, choice.get("finish_reason") == "length")


def json_object(value: Any) -> dict[str, Any]:
    """A JSON object, from bytes too; empty for anything else."""
    if isinstance(value, bytes):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError):
            return {}
    return value if isinstance(value, dict) else {}


@dataclass(frozen=True)
class Choice:
    """Choice from a menu: the number of a candidate, changed settings and the reason."""

    number: int
    settings: dict[str, Any]
    reason: str


def read_choice(text: str) -> Choice | None:
    """The choice from a menu in an answer, after any thoughts; None where there is none."""
    text = text.rpartition("</think>")[2]
    found = json_object(text[text.find("{") : text.rfind("}") + 1].encode("utf-8", "replace"))
    choice = json_object(found.get("choice"))
    number = choice.get("number")
    if not isinstance(number, int) or isinstance(number, bool):
        return None
    return Choice(number, json_object(choice.get("settings")), str(found.get("reason", "")))


# Parser of a language model's answer into a candidate with its rationale; tolerant of the form.


_TEXT = 1000
_TITLE = 60
_FAMILY = 30
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


NO_CHOICE = "the answer is no JSON object with a choice from the menu"


class MalformedReplyError(Exception):
    """Error of an answer without candidate.py; the text describes the error of its form."""


def read_reply(text: str, cut: bool = False) -> Reply:
    """Parse an answer.

    Args:
        cut: whether the answer ended at its limit of tokens

    Raises:
        MalformedReplyError: when it holds no candidate
    """
    # Without the model's thoughts, removed in one pass: a model that repeats itself must not cost
    # the square of its answer.
    parts: list[str] = []
    at = 0
    while begin := _THOUGHT.search(text, at):
        end = _THOUGHT_END.search(text, begin.end())
        if end is None:
            break
        parts.append(text[at : begin.start()])
        at = end.end()
    text = "".join((*parts, text[at:]))

    # Text outside fences, and the blocks inside.
    prose: list[str] = []
    blocks: list[str] = []
    block: list[str] = []
    fence = ""
    for line in text.splitlines():
        found = _FENCE.match(line)
        if not fence:
            if found:
                fence = found[1]
            else:
                prose.append(line)
        elif found and not found[2] and found[1].startswith(fence):
            blocks.append("\n".join(block) + "\n")
            fence, block = "", []
        else:
            block.append(line)
    if cut:
        raise MalformedReplyError("the answer ended before candidate.py was complete: be shorter")
    if fence:
        raise MalformedReplyError("the python block has no closing fence")
    if not blocks:
        raise MalformedReplyError("the answer has no fenced python block with candidate.py")

    # The last block that can be a candidate; without one the longest, and its error.
    source = next((block for block in reversed(blocks) if not _error(block)), None)
    problem = ""
    if source is None:
        source = max(blocks, key=len)
        problem = _error(source)

    # The text of each label; that of a hypothesis may go on over several lines.
    said: dict[str, str] = {}
    label = ""
    for line in prose:
        found = _LABEL.match(line)
        if found:
            label = found[1].lower()
            said[label] = found[2]
        elif label in ("hypothesis", "expected"):
            said[label] += f" {line}"
    family = one_line(said.get("family", "").lower(), _FAMILY).strip("`'\" ") or "custom"
    parent = re.search(r"\d+", said.get("parent", ""))
    return Reply(
        source=source,
        hypothesis=one_line(said.get("hypothesis", ""), _TEXT) or "not said",
        expected=one_line(said.get("expected", ""), _TEXT) or "not said",
        family=family,
        title=one_line(said.get("title", ""), _TITLE).strip("`'\" ") or family,
        parent=int(parent.group()[:9]) if parent else None,
        problem=problem,
    )


def _error(source: str) -> str:
    try:
        check_source(source)
    except CandidateError as error:
        return str(error)
    return ""


# Report on a language model in a search: contract violations and cost.


LlmVerdict = Literal["able", "able with repairs", "not able"]


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
    count = Counter(exchange.experiment for exchange in answered)
    wrong: Counter[str] = Counter()
    settings = view.started.agent_settings
    proposals = json.loads(settings.get("proposals", '"free"'))
    for exchange in answered:
        answer = read_answer(run.store.get(exchange.response))
        try:
            if proposals != "free" and read_choice(answer.text) is not None:
                continue
            if proposals == "menu":
                raise MalformedReplyError(NO_CHOICE)
            error = one_line(read_reply(answer.text, answer.cut).problem, 200)
        except MalformedReplyError as malformed:
            error = str(malformed)
        if error:
            wrong[error] += 1
    at_once = [s for s in steps if count[s.number] == 1 and s.proposed.family != NO_CANDIDATE]
    lost = [s for s in steps if s.proposed.family == NO_CANDIDATE]
    failures = Counter(s.failure.reason.value for s in steps if s.failure is not None)
    used = [e.usage for e in answered if e.usage is not None]

    def counted(found: Counter[str]) -> tuple[str, ...]:
        return tuple(f"{text} ({number} times)" for text, number in found.most_common())

    def lowest(experiments: list[Experiment]) -> float | None:
        scores = (e.score for e in experiments if not e.unconfirmed)
        return min((score.value for score in scores if score is not None), default=None)

    return LlmReport(
        model=settings.get("model", ""),
        base_url=settings.get("base_url", ""),
        steps=len(steps),
        answers=len(answered),
        at_once=len(at_once),
        repaired=len(steps) - len(at_once) - len(lost),
        without_candidate=len(lost),
        scored=sum(s.score is not None for s in steps),
        wrong=counted(wrong),
        failures=counted(failures),
        baseline=lowest([e for e in view.finished if e.proposed.phase == "baseline"]),
        best=lowest(steps),
        prompt_tokens=max((u.input_tokens for u in used), default=0),
        reply_tokens=max((u.output_tokens for u in used), default=0),
        tokens_a_step=sum(u.tokens for u in used) / len(steps) if steps else 0.0,
    )
