"""Sections of integrity and reproduction."""

from __future__ import annotations

from collections import Counter
from shlex import quote
from typing import Any

from asia._text import one_line
from asia._timer import duration
from asia.presentation.integrity import guard_table, integrity_facts
from asia.report.page.render import show
from asia.report.page.subject import Section, Subject

# The integrity of the search and its cost.


def _content(subject: Subject) -> dict[str, Any]:
    view, evaluations = subject.view, subject.evaluations
    counts = Counter(one.status for one in evaluations)
    outcomes = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    facts = [
        *integrity_facts(subject.run.directory, view),
        ("evaluations", f"{len(evaluations)} in {duration(subject.seconds)}"),
        ("outcomes", outcomes or "none yet"),
    ]
    return {"facts": facts, "blocks": show([guard_table(view)] if view.looks else [])}


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
