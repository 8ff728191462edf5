"""Sections of integrity and reproduction."""

from __future__ import annotations

from shlex import quote
from typing import Any

from asia._text import one_line
from asia.judge.scoring.outcome import Score
from asia.ledger.events import GuardLooked
from asia.ledger.looks import seal_words
from asia.presentation.table import FORMATS
from asia.report.page.subject import Section, Subject

# The integrity of the search and its cost.


def _content(subject: Subject) -> dict[str, Any]:
    view, evaluations = subject.view, subject.evaluations
    oracle = "none: candidates hold out parts of their own training data"
    if view.started.early_stopping != "inner":
        count = sum(one.validation_scores for one in evaluations)
        oracle = f"{count}: V is not leak-free"
    guard = "none"
    if view.started.guard_digest is not None:
        looks = sum(isinstance(line.event, GuardLooked) for line in subject.run.lines)
        asked = sum(one.confirmation is not None for one in evaluations)
        guard = f"{looks} looks; asked for {asked} new bests, one bit each at most"
    outcomes = [
        f"{sum(one.status == status for one in evaluations)} {status}"
        for status in sorted({e.result.status for e in view.finished if e.result})
    ]
    seal = None
    if view.started.test_digest is not None:
        seal = seal_words(subject.run.directory, view)
        if seal is None and view.unsealing is None:
            seal = "never opened"
    looks = [
        [
            [FORMATS["number"](one.experiment),
             FORMATS["error"](one.outcome.value) if isinstance(one.outcome, Score) else "no score"]
            for one in look.scores
        ]
        for look in view.looks
    ]  # fmt: skip
    return {
        "oracle": oracle,
        "guard": guard,
        "outcomes": ", ".join(outcomes) or "none yet",
        "seal": seal,
        "cost": _cost(subject),
        "looks": looks,
    }


def _cost(subject: Subject) -> str:
    view = subject.view
    if view.usage is None:
        return "none used"
    used = [one.usage for one in (*view.exchanges, *view.sessions) if one.usage is not None]
    tokens = sum(one.input_tokens + one.output_tokens for one in used) if used else "no"
    if view.usage.cost is None:
        return f"{tokens} tokens, cost unknown"
    costs = [one.cost for one in used if one.cost is not None]
    return f"{tokens} tokens, {FORMATS['dollars'](sum(costs))}"


SECTION = Section("integrity", "Integrity and cost", _content)


# The commands that reproduce the result.


def _reproduction(subject: Subject) -> dict[str, Any]:
    start = subject.view.started
    # Names that the ledger brings are quoted: somebody will copy these lines into a shell.
    name, problem, agent = (
        quote(one_line(text, most))
        for text, most in ((start.run, 120), (start.problem, 120), (start.agent, 60))
    )
    commands = (
        f"asia verify {name}           # check the hash chain of the ledger and every artifact\n"
        f"asia verify {name} --replay  # evaluate every candidate again and compare\n"
        f"asia run {problem} --agent {agent} "
        f"--experiments {subject.view.budget} --seed {start.seed}\n"
    )
    settings, versions = (
        ", ".join(f"{key} {value}" for key, value in sorted(found.items()))
        for found in (start.agent_settings, start.environment)
    )
    return {"commands": commands, "settings": settings, "versions": versions}


REPRODUCE = Section("reproduce", "Reproduction", _reproduction)
