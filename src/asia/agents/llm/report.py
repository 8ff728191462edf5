"""Report on a language model in a search: contract violations and cost."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

from asia._text import one_line
from asia.agents.llm.client import read_answer
from asia.agents.llm.reply import MalformedReplyError, read_reply
from asia.agents.llm.search import NO_CANDIDATE
from asia.ledger import Exchanged, Experiment, Run

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
        baseline=_best([e for e in view.finished if e.proposed.phase == "baseline"]),
        best=_best(steps),
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


def _best(experiments: list[Experiment]) -> float | None:
    return min((e.score.value for e in experiments if e.score is not None), default=None)
