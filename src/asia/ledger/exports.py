"""results.tsv and search_journal.md, generated from the view."""

from __future__ import annotations

import re
from itertools import zip_longest
from pathlib import Path
from statistics import fmean

from asia._text import markdown_line, one_line, table_cell
from asia.judge.scoring.outcome import Score
from asia.ledger.chain import write_whole
from asia.ledger.events import Evaluated, HandedOver, HandOverReason, Phase, Validated
from asia.ledger.view import Experiment, SearchView

# One-line descriptions of failures.


_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')

_PHASES: dict[Phase, str] = {
    "baseline": "the baseline",
    "explore": "early in the budget",
    "refine": "later in the budget",
}
_ENDED: dict[HandOverReason, str] = {
    "planned": "experiments spent",
    "saturated": "no improvement in the last experiments",
    "exhausted": "no proposals left",
    "stuck": "no progress",
    "tokens": "tokens spent",
    "cost": "money spent",
    "time": "time spent",
    "agent": "it ended",
}


def hand_over_text(event: HandedOver) -> str:
    """`bayes takes over after #05; stop reason of the previous agent: experiments spent`."""
    detail = f" ({event.detail})" if event.detail else ""
    return (
        f"{event.agent} takes over after #{event.after:02d}; stop reason of the previous agent: "
        f"{_ENDED[event.reason]}{detail}"
    )


def validation_summary(event: Validated) -> str:
    """`pass 7, doubt 2, fail 1: the residual of level drifts with time`."""
    counts = f"pass {event.passed}, doubt {event.doubtful}, fail {event.failed}"
    where = f" on {event.record}" if event.record else ""
    worst = next((c.sentence for c in event.checks if c.name == event.worst), "")
    return f"{counts}{where}: {worst}" if worst else f"{counts}{where}"


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)


def phase_text(phase: Phase) -> str:
    """Describe the part of the budget in which an experiment lies. Its hypothesis is the agent's
    choice.
    """
    return _PHASES[phase]


# results.tsv and search_journal.md, written anew from the view after every event.


def write_exports(directory: Path, view: SearchView) -> None:
    """Both files, each replaced in one step. Raises UserError when the disk refuses."""
    for name, text in (("results.tsv", results_table(view)), ("search_journal.md", journal(view))):
        write_whole(directory / name, text.encode("utf-8", "replace"), durable=False)


def results_table(view: SearchView) -> str:
    """Write the experiments as a tab-separated table.

    Columns: experiment, val, status, description, parent, seconds of the evaluation, val of each
    fold, and in a relay the agent. A failure has no number. With validation early stopping the name
    of the second column says so.
    """
    val = view.v_name.replace("V", "val", 1)
    rows = [
        f"experiment\t{val}\tstatus\tdescription\tparent\tseconds\tfolds"
        + ("\tagent" if view.leg else "")
    ]
    for e in view.finished:
        assert e.result is not None
        cells = (
            str(e.number),
            f"{e.score.value:.6f}" if e.score else "",
            e.result.status,
            table_cell(_description(e)),
            "" if e.proposed.parent is None else str(e.proposed.parent),
            f"{e.result.seconds:.1f}",
            " ".join(f"{fold.value:.6f}" for fold in e.score.folds) if e.score else "",
        )
        agent = (table_cell(e.proposed.agent),) if view.leg else ()
        rows.append("\t".join((*cells, *agent)))
    return "\n".join(rows) + "\n"


def _description(e: Experiment) -> str:
    """The title; the whole hypothesis where the title is only its beginning; the mean of V over
    seeds where there is one."""
    title, hypothesis = e.proposed.title, e.proposed.hypothesis
    text = hypothesis if hypothesis.startswith(title.removesuffix("…")) else title
    return f"{text} ({mean})" if (mean := seed_mean_words(e)) else text


def journal(view: SearchView) -> str:
    """Write the journal of a search: hypothesis, reason and result of each experiment."""
    start = view.started
    parts = [
        f"# Search journal: {markdown_line(start.run)}\n\n"
        f"Problem {markdown_line(start.problem)}, agent {markdown_line(start.agent)}, "
        f"seed {start.seed}, isolation {start.isolation_words}.\n"
        f"{_references(view)}{_setting(view)}"
    ]
    finished = view.finished
    for e, later in zip_longest(finished, finished[1:]):
        parts += [_hand_over(event) for event in view.handed_over if event.after == e.number - 1]
        parts.append(_entry(view, e, later))
    return "\n".join(parts)


def _references(view: SearchView) -> str:
    if not view.rungs:
        return ""
    values = [
        f"{reference.name} {error_value(reference.outcome.value)}"
        for reference in view.rungs
        if isinstance(reference.outcome, Score)
    ]
    return f"\nReference models, {view.v_name}: {', '.join(values)}.\n"


def _setting(view: SearchView) -> str:
    return _validation_setting(view) + _residuals_setting(view)


def _residuals_setting(view: SearchView) -> str:
    if view.started.residuals == "train":
        return ""
    return (
        "\nHeld-out residuals are shown: the agent sees the errors on the held-out samples. V is "
        "only comparable with V of the same setting.\n"
    )


def _validation_setting(view: SearchView) -> str:
    if view.started.early_stopping == "inner":
        return ""
    return (
        "\nValidation early stopping: candidates received their score on the held-out parts, "
        f"{view.validation_scores} times so far. V is not leak-free and only comparable with V "
        "of the same setting.\n"
    )


def _hand_over(event: HandedOver) -> str:
    return f"## Hand-over\n\n{markdown_line(hand_over_text(event))}.\n"


def _entry(view: SearchView, e: Experiment, later: Experiment | None) -> str:
    p, r = e.proposed, e.result
    assert r is not None
    origin = f" (from experiment {p.parent})" if p.parent else ""
    by = f", by {markdown_line(p.agent)}" if p.agent else ""
    following = markdown_line(later.proposed.title) if later else "none yet"
    remark = f"- **Remark:** {markdown_line(p.remark)}\n" if p.remark else ""
    return (
        f"## Experiment {e.number}: {markdown_line(p.title)}\n\n"
        f"- **Changed:** {markdown_line(p.family)}, {phase_text(p.phase)}{origin}{by}\n"
        f"- **Hypothesis:** {markdown_line(p.hypothesis)}\n"
        f"- **Expected:** {markdown_line(p.expected)}\n"
        f"- **Result:** {markdown_line(describe_result(e, view))}\n"
        f"- **Decision:** {r.status}\n"
        f"- **Next:** {following}\n{remark}"
    )


def seed_mean_words(e: Experiment) -> str:
    """`mean of 3 seeds 0.1312`, which decides whether its method is kept; "" for a single fit."""
    values = e.seed_values
    if len(values) < 2:
        return ""
    return f"mean of {len(values)} seeds {error_value(fmean(values))}"


def validation_score_words(result: Evaluated) -> str:
    """Describe the number of requests of an experiment for its score on the held-out parts."""
    count = result.validation_scores
    return f"{count} validation score{'' if count == 1 else 's'}"


def error_value(value: float) -> str:
    """Four decimals; powers of ten where a simulation ran away."""
    return f"{value:.4f}" if value < 1e4 else f"{value:.2e}"


def describe_result(e: Experiment, view: SearchView) -> str:
    """Describe a result in one line: V and its folds, or the failure with advice."""
    left = e.result.left_behind if e.result else ()
    stuck = f"; worker process {', '.join(map(str, left))} could not be terminated" if left else ""
    return _outcome_text(e, view) + stuck


def _outcome_text(e: Experiment, view: SearchView) -> str:
    if e.score and e.result:
        folds = ", ".join(error_value(f.value) for f in e.score.folds)
        asked = (
            ""
            if view.started.early_stopping == "inner"
            else f", {validation_score_words(e.result)}"
        )
        parts = f" (folds {folds}{asked})" if folds else ""
        return f"{view.v_name} = {error_value(e.score.value)}{parts}{_retest_text(e)}"
    if e.failure:
        where = f" in fold {e.failure.fold}" if e.failure.fold else ""
        message = error_line(e.failure.detail)
        detail = f" ({message})" if message else ""
        return f"no score{where}: {e.failure.advice}{detail}"
    return "being evaluated"


def _retest_text(e: Experiment) -> str:
    """`; repeated fits 0.1352, 0.1298, mean of 3 seeds 0.1320; required: a mean 0.0031 below the
    incumbent's`."""
    assert e.result is not None
    values = [r.failed if r.value is None else error_value(r.value) for r in e.result.retests]
    text = f"; repeated fits {', '.join(values)}" if values else ""
    if mean := seed_mean_words(e):
        text += f", {mean}"
    if any(r.same for r in e.result.retests):
        text = "; equal with another seed"
    if e.result.floor:
        text += f"; required: a mean {e.result.floor:.2g} below the incumbent's"
    return text
