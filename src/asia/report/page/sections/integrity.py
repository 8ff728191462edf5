"""Sections of integrity and reproduction."""

from __future__ import annotations

from collections.abc import Sequence
from shlex import quote

from asia._text import one_line
from asia.judge.scoring.outcome import Score
from asia.ledger.looks import seal_words
from asia.ledger.text import hand_over_text
from asia.report.page.html import Html, facts, join, region, said, table, tag
from asia.report.page.subject import Section, Subject

# The integrity of the search and its cost.


def _write(subject: Subject) -> Html:
    view = subject.view
    start = view.started
    layers = ", ".join(start.layers)
    level = join((tag("b", start.isolation_words), " ", said(f"({layers})") if layers else None))
    oracle: Html | str = "none: candidates hold out parts of their own training data"
    if start.early_stopping != "inner":
        count = subject.over("evaluated", "validation_scores", "sum", "count")
        oracle = join((count, ": V is not leak-free"))
    guard: Html | str = "none"
    if start.guard_digest is not None:
        count = subject.over("guard", "look", "count", "count")
        asked = subject.over("evaluated", "confirmation.since", "count", "count")
        guard = join((count, " looks; asked for ", asked, " new bests, one bit each at most"))
    count = subject.over("evaluated", "experiment", "count", "count")
    spent = subject.over("evaluated", "seconds", "sum", "duration")
    outcomes = [
        join((subject.over("evaluated", f"status={status}", "count", "count"), f" {status}"))
        for status in sorted({e.result.status for e in view.finished if e.result})
    ]
    pairs = (
        ("isolation", level),
        (
            "missing protection",
            said("; ".join(start.isolation_notes), 800) if start.isolation_notes else None,
        ),
        ("test", _test(subject)),
        ("held-out scores shown to candidates", oracle),
        ("guard records", guard),
        ("notes of the user", _list([note.text for note in view.notes]) or "none"),
        ("evaluations", join((count, " in ", spent))),
        ("outcomes", join(outcomes, ", ") or "none yet"),
        ("language model", _cost(subject)),
        ("failed diagnostics", _list(view.failed_checks)),
    )
    relays = [tag("li", said(hand_over_text(event))) for event in view.handed_over]
    looks: list[Html] = []
    for look in view.looks:
        rows: list[list[str | None]] = []
        for k, score in enumerate(look.scores):
            scored, at = isinstance(score.outcome, Score), f"scores.{k}"
            value = subject.number(look, f"{at}.outcome.value", "error") if scored else "no score"
            rows.append([subject.number(look, f"{at}.experiment", "number"), value])
        head = ["experiment", "error on the guard records"]
        looks.append(table(head, rows, "Evaluation on the guard records"))
    return join((facts(pairs), tag("ul", *relays) if relays else None, *looks))


def _list(lines: Sequence[str]) -> Html | None:
    return tag("ul", *(tag("li", said(line, 600)) for line in lines)) if lines else None


def _test(subject: Subject) -> Html | str:
    view = subject.view
    if view.started.test_digest is None:
        return "none"
    digest = tag("code", view.started.test_digest[:12])
    state = "opened by this run once, after the search" if view.unsealed else "sealed"
    consent = view.unsealing is not None and view.unsealing.process_consent
    agreed = (
        "; the user agreed to open it, although candidates could have read it" if consent else ""
    )
    words = seal_words(subject.run.directory, view)
    if words is None and view.unsealing is None:
        words = "never opened"
    looks = None if words is None else join(("; ", said(words, 800)))
    return join((state, "; digest recorded before the first experiment: ", digest, agreed, looks))


def _cost(subject: Subject) -> Html | str:
    view = subject.view
    if view.usage is None:
        return "none used"
    used = [event for event in (*view.exchanges, *view.sessions) if event.usage is not None]
    kinds = ("usage.input_tokens", "usage.output_tokens")
    parts = [(event, kind) for event in used for kind in kinds]
    tokens = subject.made("sum", "count", *parts) if parts else "no"
    if view.usage.cost is None:
        return join((tokens, " tokens, cost unknown"))
    costs = [(e, "usage.cost") for e in used if e.usage is not None and e.usage.cost is not None]
    return join((tokens, " tokens, ", subject.made("sum", "dollars", *costs)))


SECTION = Section("integrity", "Integrity and cost", _write)


# The commands that reproduce the result.


def _write_reproduce(subject: Subject) -> Html:
    start, lines = subject.view.started, subject.run.lines
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
    block = region("pre", tag("code", commands), label="commands")
    settings = ", ".join(f"{key} {value}" for key, value in sorted(start.agent_settings.items()))
    versions = ", ".join(f"{key} {value}" for key, value in sorted(start.environment.items()))
    pairs = (
        ("digest of the problem file", tag("code", start.lock_digest)),
        ("digest of the protocol", tag("code", start.protocol_digest)),
        (
            "digest of the sealed test",
            tag("code", start.test_digest) if start.test_digest else None,
        ),
        ("digest of the ledger", tag("code", lines[-1].digest)),
        ("start", said(lines[0].time)),
        ("last event", join((said(lines[-1].event.event), ", ", said(lines[-1].time)))),
        ("environment", said(versions, 1000)),
        ("settings", said(settings, 1000) if settings else None),
    )
    return join((block, facts(pairs)))


REPRODUCE = Section("reproduce", "Reproduction", _write_reproduce)
