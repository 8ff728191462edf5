"""Section of the commands that reproduce the result."""

from __future__ import annotations

import hashlib

from asia._text import one_line
from asia.report._page.html import Html, facts, join, said, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject


def _write(subject: Subject) -> Html:
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


SECTION = Section("reproduce", "Reproduction", _write)
