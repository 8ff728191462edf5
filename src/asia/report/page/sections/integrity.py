"""Sections of integrity and reproduction."""

from __future__ import annotations

import hashlib

from asia._text import one_line
from asia.judge.scoring.outcome import Score
from asia.ledger.events import GuardLooked
from asia.ledger.text import hand_over_text
from asia.report.page.html import Html, facts, join, said, table, tag
from asia.report.page.subject import Section, Subject

# Section of the integrity of the search and of its cost.


def _write(subject: Subject) -> Html:
    view = subject.view
    start = view.started
    notes = "; ".join(start.isolation_notes)
    layers = ", ".join(start.layers)
    pairs = (
        (
            "isolation",
            join((tag("b", start.isolation_words), " ", said(f"({layers})") if layers else None)),
        ),
        ("missing protection", said(notes, 800) if notes else None),
        ("test", _test(subject)),
        ("held-out scores shown", _oracle(subject)),
        ("guard records", _guard(subject)),
        ("notes of the user", _notes(subject)),
        ("evaluations", _time(subject)),
        ("outcomes", _outcomes(subject)),
        ("language model", _cost(subject)),
        ("failed diagnostics", _failed(subject)),
    )
    relays = [tag("li", said(hand_over_text(event))) for event in view.handed_over]
    relay = tag("ul", *relays) if relays else None
    return join((facts(pairs), relay, *(_look(subject, look) for look in view.looks)))


def _test(subject: Subject) -> Html:
    view = subject.view
    if view.started.test_digest is None:
        return join(("none",))
    digest = tag("code", view.started.test_digest[:12])
    state = "opened once, after the search" if view.unsealed else "sealed, never opened"
    consent = view.unsealing is not None and view.unsealing.process_consent
    agreed = "; the user agreed to open it although candidates could read it" if consent else ""
    before = view.unsealing.opened_before if view.unsealing else ()
    earlier = join(("; opened before by ", said(", ".join(before)))) if before else None
    return join((state, ", committed before the first experiment as ", digest, agreed, earlier))


def _oracle(subject: Subject) -> Html:
    if subject.view.started.early_stopping == "inner":
        return join(("none: candidates hold out parts of their own training data",))
    count = subject.over("evaluated", "validation_scores", "sum", "count")
    return join((count, ": V is not leak-free"))


def _guard(subject: Subject) -> Html:
    if subject.view.started.guard_digest is None:
        return join(("none",))
    if not subject.view.looks:
        return join(("not evaluated yet",))
    return join(("looked at ", subject.over("guard", "look", "count", "count"), " times"))


def _notes(subject: Subject) -> Html:
    notes = [tag("li", said(note.text, 600)) for note in subject.view.notes]
    return tag("ul", *notes) if notes else join(("none",))


def _failed(subject: Subject) -> Html | None:
    lines = [tag("li", said(line, 600)) for line in subject.view.failed_checks]
    return tag("ul", *lines) if lines else None


def _time(subject: Subject) -> Html:
    count = subject.over("evaluated", "experiment", "count", "count")
    spent = subject.over("evaluated", "seconds", "sum", "duration")
    return join((count, " in ", spent))


def _outcomes(subject: Subject) -> Html:
    found = {e.result.status: None for e in subject.view.finished if e.result}
    parts = [
        join((subject.over("evaluated", f"status={status}", "count", "count"), f" {status}"))
        for status in sorted(found)
    ]
    return join(parts, ", ") if parts else join(("none yet",))


def _cost(subject: Subject) -> Html:
    view = subject.view
    usage = view.usage
    if usage is None:
        return join(("none was asked",))
    parts = [
        (event, f"usage.{name}")
        for event in (*view.exchanges, *view.sessions)
        if event.usage is not None
        for name in ("input_tokens", "output_tokens")
    ]
    tokens = subject.made("sum", "count", *parts) if parts else "no"
    if usage.cost is None:
        return join((tokens, " tokens, cost unknown"))
    costs = [
        (event, "usage.cost")
        for event in (*view.exchanges, *view.sessions)
        if event.usage is not None and event.usage.cost is not None
    ]
    return join((tokens, " tokens, ", subject.made("sum", "dollars", *costs)))


def _look(subject: Subject, look: GuardLooked) -> Html:
    rows = [
        [
            subject.number(look, f"scores.{k}.experiment", "number"),
            subject.number(look, f"scores.{k}.outcome.value", "error")
            if isinstance(score.outcome, Score)
            else "no score",
        ]
        for k, score in enumerate(look.scores)
    ]
    caption = "Evaluation on the guard records"
    return table(["experiment", "error on the guard records"], rows, caption)


SECTION = Section("integrity", "Integrity and cost", _write)


# Section of the commands that reproduce the result.


def _write_reproduce(subject: Subject) -> Html:
    start, last = subject.view.started, subject.run.lines[-1]
    name = one_line(start.run, 120)
    commands = (
        f"asia verify {name}       # the chain of the ledger and every artifact\n"
        f"asia verify {name} --replay # every candidate again, compared\n"
        f"asia run {one_line(start.problem, 120)} --agent {one_line(start.agent, 60)} "
        f"--experiments {subject.view.budget} --seed {start.seed}\n"
    )
    block = tag("pre", tag("code", commands), tabindex="0", role="region", aria_label="commands")
    versions = ", ".join(f"{key} {value}" for key, value in sorted(start.environment.items()))
    pairs = (
        ("problem file", tag("code", start.lock_digest)),
        ("protocol", tag("code", start.protocol_digest)),
        ("sealed test", tag("code", start.test_digest) if start.test_digest else None),
        ("ledger, last line", tag("code", _head(subject))),
        ("begun", said(subject.run.lines[0].time)),
        ("last event", join((said(last.event.event), ", ", said(last.time)))),
        ("environment", said(versions, 1000)),
        ("settings", _settings(subject)),
    )
    return join((block, facts(pairs)))


def _settings(subject: Subject) -> Html | None:
    settings = subject.view.started.agent_settings
    if not settings:
        return None
    return said(", ".join(f"{key} {value}" for key, value in sorted(settings.items())), 1000)


def _head(subject: Subject) -> str:
    """sha256 of the ledger's last line, as the next one would name it."""
    lines = (subject.run.directory / "ledger.jsonl").read_bytes().split(b"\n")
    return hashlib.sha256(lines[len(subject.run.lines) - 1]).hexdigest()


REPRODUCE = Section("reproduce", "Reproduction", _write_reproduce)
