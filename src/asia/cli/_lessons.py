"""asia lessons: what earlier searches taught."""

from __future__ import annotations

import json as jsonlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.cli._options.shared import DEFAULT_RUNS, Json, Runs

if TYPE_CHECKING:
    from asia.agents.lessons import Lesson
    from asia.search import RunLessons

_WITHOUT = ("random", "bayes")


def lessons(
    forget: Annotated[
        bool, typer.Option("--forget", help="Remove the lessons that you keep.")
    ] = False,
    export: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write your lessons to a file.")
    ] = None,
    import_: Annotated[
        Path | None,
        typer.Option("--import", metavar="FILE", help="Add the lessons of an exported file."),
    ] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Show those that come with the package, and no more.")
    ] = False,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Learn from the finished runs which move brought what on which kind of system, and show it.

    The lessons are kept in your data folder. A search uses them with asia run --lessons own, and
    none without that option. They hold V of the cross-validation, and no figure of a test.
    """
    from asia.agents.lessons import (
        encode_lessons,
        forget_lessons,
        keep_lessons,
        kept_lessons,
        notebook_path,
        shipped_lessons,
    )
    from asia.errors import UserError
    from asia.ledger import write_whole
    from asia.search import learn_from_runs

    if sum((forget, export is not None, import_ is not None, shipped)) > 1:
        raise UserError("--forget, --export, --import and --shipped: give one of them")
    if forget:
        said = "removed" if forget_lessons() else "there were none:"
        say(f"{said} {notebook_path()}")
    elif export is not None:
        found = kept_lessons()
        write_whole(export, encode_lessons(found))
        say(f"{len(found)} lessons written to {export}")
    elif import_ is not None:
        _show(keep_lessons(read_lessons(import_)), json=json)
    elif shipped:
        _show(shipped_lessons(), json=json)
    else:
        learned = learn_from_runs(runs)
        kept = keep_lessons(learned.lessons) if learned.lessons else kept_lessons()
        if not json:
            _say_learned(learned, runs)
        _show(kept, json=json)


def chosen_lessons(which: str | None, agent: str) -> tuple[Lesson, ...] | None:
    """The lessons that a search is to have; None for none. Raises UserError for an agent that has
    no use for them, and for a file that is none of lessons."""
    from asia.agents import asked_relay
    from asia.agents.lessons import kept_lessons, merge, shipped_lessons
    from asia.errors import UserError

    if which is None or which == "off":
        return None
    proposing = [leg.agent for leg in asked_relay(agent)] or [agent]
    if all(name in _WITHOUT or name.startswith("command:") for name in proposing):
        raise UserError(
            f"--lessons {which}: the agent '{agent}' does not use lessons: leave it out, or choose "
            "expert, llm or a class of your own"
        )
    sets = {
        "own": kept_lessons,
        "shipped": shipped_lessons,
        "all": lambda: merge(shipped_lessons(), kept_lessons()),
    }
    found = sets[which]() if which in sets else read_lessons(Path(which))
    searches = len({lesson.run for lesson in found})
    say(
        f"lessons  {len(found)} of {searches} earlier searches; a run that exists keeps its own",
        file=sys.stderr,
    )
    return found


def read_lessons(path: Path) -> tuple[Lesson, ...]:
    """The lessons of an exported file. Raises UserError."""
    from asia._files import read_file
    from asia.agents.lessons import decode_lessons

    remedy = "name a file that asia lessons --export wrote"
    return decode_lessons(read_file(path, remedy), str(path))


def _say_learned(learned: RunLessons, runs: Path) -> None:
    say(f"learned from {len(learned.learned)} runs in {runs}")
    for name, why in learned.left_out:
        say(f"left out {name}: {why}")


def _show(lessons: tuple[Lesson, ...], *, json: bool) -> None:
    from dataclasses import asdict

    from asia.agents.lessons import notebook_path, summaries

    found = summaries(lessons)
    if json:
        say(jsonlib.dumps([asdict(one) for one in found]))
        return
    for one in found:
        say(f"{one.family:<16}{one.move:<44}{one.words}")
    searches = len({lesson.run for lesson in lessons})
    say(f"{len(lessons)} lessons from {searches} searches; yours are kept in {notebook_path()}")
