"""Text and numbers on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from asia._text import printable
from asia._timer import Activity, Seconds, TimeSpent, add_seconds, duration
from asia.judge.scoring.outcome import Failure, Outcome, Score
from asia.ledger.events import (
    Evaluated,
    Event,
    GuardLooked,
    HandedOver,
    Refitted,
    RungScored,
    Usage,
)
from asia.ledger.run import model_to_use
from asia.ledger.text import error_value, seed_mean_words, stack_words, validation_score_words
from asia.ledger.view import Experiment, SearchView

if TYPE_CHECKING:
    from asia.judge.scoring.residuals import Diagnostics
    from asia.report.published import Board


# Text for results: experiments, scores, stop reasons, models.


NOT_LEAK_FREE = (
    "validation early stopping: candidates may request their score on the held-out parts, so V "
    "is not leak-free and only comparable with V of the same setting"
)


RESIDUALS_SHOWN = (
    "held-out residuals are shown to the agent, which can fit a model to them, so V is only "
    "comparable with V of the same setting"
)

# V divided by V of the training mean, above which a model is no better than the mean.
_BETTER = 0.95


def validation_words(validation_scores: int) -> str:
    """Return the note on V with validation early stopping, with the number of validation scores."""
    return (
        f"with validation early stopping, not leak-free; {validation_scores} validation scores "
        "were given"
    )


def value_words(outcome: Outcome) -> str:
    """Return V, or the reason of the failure."""
    return error_value(outcome.value) if isinstance(outcome, Score) else outcome.reason.value


def last_line(failure: Failure) -> str:
    """Return the last line of the detail of a failure, or its advice."""
    lines = failure.detail.strip().splitlines()
    return lines[-1].strip()[:160] if lines else failure.advice


def experiment_line(experiment: Experiment, view: SearchView) -> str:
    """`#07 keep  V=0.1310  min fit 87.2 % ... | best #07 0.1310`: one greppable line, with the
    lowest fit index over folds and outputs, that ends with the lowest V at that time. With
    validation early stopping it says how many validation scores were given.

    V is that of one fit on both sides. A candidate that was fitted from several seeds has a mean as
    well, which decides what is kept: `... | mean of 3 seeds 0.1422 | best #04 0.0890, lowest mean
    of seeds #07 0.1422`."""
    r = experiment.result
    assert r is not None
    if experiment.score:
        fits = [f.worst_fit for f in experiment.score.folds if f.worst_fit is not None]
        worst = min(fits, default=None)
        fit = "   -  " if worst is None else f"{worst:5.1f} %" if worst > -999 else "<-999 %"
        found = f"V={error_value(experiment.score.value)}  min fit {fit}"
    else:
        found = f"{r.outcome.reason.value if not isinstance(r.outcome, Score) else '':<24}"
    best, mean = best_at(experiment.number, view), seed_mean_words(experiment)
    tail = "best none"
    if best and best.score:
        tail = f"best #{best.number:02d} {error_value(best.score.value)}"
        kept = [e for e in view.finished if e.kept and e.number <= experiment.number]
        if kept and (mean or kept[-1].number != best.number):
            value = error_value(fmean(kept[-1].seed_values))
            several = "lowest mean of seeds" if len(kept[-1].seed_values) > 1 else "kept"
            tail += f", {several} #{kept[-1].number:02d} {value}"
    proposed = experiment.proposed
    title = f"{proposed.agent}: {proposed.title}" if proposed.agent else proposed.title
    asked = "" if view.started.early_stopping == "inner" else f" | {validation_score_words(r):<21}"
    # As wide as `inconclusive` with its figures.
    outcome = f"{r.status:<7} {found}"
    return (
        f"#{experiment.number:02d} {outcome:<38}  {duration(r.seconds):>6}  "
        f"{title:<44}{asked}{f' | {mean}' if mean else ''} | {tail}"
    )


def running_words(view: SearchView) -> list[str]:
    """Return `#05 refine: linear, one state more` for each experiment in flight, and whether its
    fit has ended."""
    return [
        f"#{e.number:02d} {e.proposed.phase}: {e.proposed.title}"
        + (" (fitted, waits for its turn)" if e.landed is not None else "")
        for e in view.running
    ]


def best_at(number: int, view: SearchView) -> Experiment | None:
    """Return the best experiment after experiment `number`."""
    bests = [e for e in view.bests if e.number <= number]
    return bests[-1] if bests else None


def guard_words(view: SearchView) -> str:
    """Return the last look at the guard: `#07 0.2310, #09 0.2280; it picks #09, ...`."""
    look = view.looks[-1]
    scores = ", ".join(f"#{s.experiment:02d} {value_words(s.outcome)}" for s in look.scores)
    best = view.best
    winner = (
        "" if best is None or best.number == look.pick else f", the winner is #{best.number:02d}"
    )
    pick = "none" if look.pick is None else f"#{look.pick:02d}"
    return f"{scores}; it picks {pick}{winner} (look {look.look})"


def again_words(view: SearchView) -> str:
    """Return the difference that a second fit of one fold of the winner showed; "" if none."""
    again = view.refitted.again if view.refitted else None
    if again is None or again.ratio == 1.0:
        return ""
    if again.ratio is None:
        return (
            f"fold {again.fold}, fitted a second time, fails ({again.failed}): "
            "V varies over repeated fits"
        )
    return (
        f"fold {again.fold}, fitted a second time, has {again.ratio:.4g} times its error: "
        "V varies over repeated fits"
    )


def use_lines(view: SearchView) -> list[str]:
    """Return the model to use of a finished search with its reason, and the other models."""
    named, refitted = model_to_use(view), view.refitted
    if named is None or refitted is None:
        return []
    lines = [f"use     {named.model}: {named.reason}", *_no_better_than_mean(view)]
    if refitted.model is None and refitted.detail and named.model != "ensemble":
        lines.append(f"refit   none: {refitted.detail}")
    if refitted.stack is not None:
        stack = refitted.stack
        lines.append(
            f"stack   nested {view.v_name}={error_value(stack.value)} {stack_words(stack)}"
        )
    return lines


def _no_better_than_mean(view: SearchView) -> list[str]:
    """Return advice if the best V is no better than that of the mean of the data."""
    mean = next((r.outcome for r in view.rungs if r.name == "training mean"), None)
    best = view.best.score if view.best is not None else None
    if best is None or not isinstance(mean, Score) or best.value < _BETTER * mean.value:
        return []
    return [
        f"doubt   nothing is clearly better than the mean of the data, whose {view.v_name} is "
        f"{error_value(mean.value)}: do the inputs act on the outputs, was the plant in closed "
        "loop, is it unstable? Read asia check; for an unstable plant use short windows, "
        'kind = "windows" in [protocol]'
    ]


def stop_words(reason: str, view: SearchView) -> str:
    """Return the stop reason as text; the agent's own text if it found nothing left to try."""
    if reason == "saturated" and view.stopped is not None and view.stopped.detail:
        return f"saturated: {view.stopped.detail}"
    return {
        "budget": f"the budget of {view.budget} experiments is spent (extend: --experiments)",
        "saturated": "saturated: the last experiments found nothing better",
        "exhausted": "the agent has nothing left to try",
        "hours": "the wall-clock budget is spent",
        "user": "on request; the same command continues",
        "stuck": "the agent was stuck; the same command continues",
        "tokens": "the token budget is spent; the same command with more tokens continues",
        "cost": "the money budget is spent; the same command with more continues",
        "time": "the agent's time is spent; the same command with more continues",
        "agent": "the agent ended; the same command starts it again",
    }[reason]


def usage_words(usage: Usage) -> str:
    """`12 replies, 40310 tokens in (1200 cached), 8120 out, 0.0231 USD`."""
    cost = "cost unknown" if usage.cost is None else f"{usage.cost:.4f} USD"
    return (
        f"{usage.turns} replies, {usage.input_tokens} tokens in ({usage.cached_tokens} cached), "
        f"{usage.output_tokens} out, {cost}"
    )


def event_object(event: Event, view: SearchView) -> dict[str, Any]:
    """Return an event as a flat JSON object."""
    if isinstance(event, Evaluated):
        best = view.best
        experiment = view.experiment(event.experiment)
        return {
            "event": "evaluated",
            "experiment": event.experiment,
            "status": event.status,
            "V": experiment.score.value if experiment.score else None,
            "reason": experiment.failure.reason.value if experiment.failure else None,
            "title": experiment.proposed.title,
            "seconds": round(event.seconds, 3),
            "validation_scores": event.validation_scores,
            "retests": [r.value for r in event.retests],
            "floor": event.floor,
            "failed_checks": list(event.failed_checks),
            "best": best.number if best else None,
        }
    if isinstance(event, HandedOver):
        return {
            "event": "handed_over",
            "agent": event.agent,
            "after": event.after,
            "reason": event.reason,
        }
    if isinstance(event, RungScored):
        value = event.outcome.value if isinstance(event.outcome, Score) else None
        return {"event": "rung", "name": event.name, "V": value}
    if isinstance(event, GuardLooked):
        return {
            "event": "guard",
            "look": event.look,
            "pick": event.pick,
            "V": {
                str(s.experiment): s.outcome.value if isinstance(s.outcome, Score) else None
                for s in event.scores
            },
        }
    if isinstance(event, Refitted):
        again = event.again
        beside = {} if again is None else {"again_fold": again.fold, "again_ratio": again.ratio}
        return {"event": "refitted", "experiment": event.experiment, "use": event.use, **beside}
    return {"event": event.event}


# Terminal output without control characters from outside.


class Terminal(Console):
    """Console that prints text literally and removes its control characters. Only rich itself sets
    colours and moves the cursor."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **settings)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Filter all output, live displays included."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)


# Residual analysis of the training data as text.


def training_lines(found: Diagnostics) -> tuple[str, ...]:
    """Return the figures of the worst output, of a fold or of the worst fold."""
    return (
        f"training side, worst fold and output: error {found.train_error:.3g} as in V, mean "
        f"residual {found.bias:.2g} s.d.",
        f"  correlation of the residual with its own past {found.whiteness:.2f}, with past inputs "
        f"{found.input_correlation:.2f}, with the squared output {found.curvature:.2f}",
        f"  RMS residual over that of all samples: output in its top tenth {found.top_error:.2f}, "
        f"bottom tenth {found.bottom_error:.2f}; first 5 % of a record {found.start_error:.2f}",
    )


# Time of a search by activity, as a table.


ABSENT = "not recorded"
_NOT_IN_LEDGER = (Activity.PREPARE, Activity.PICTURES)


def summed(events: Iterable[Event], beside: Sequence[TimeSpent] = ()) -> tuple[TimeSpent, ...]:
    """Sum the seconds of each activity over all events. beside: seconds that the ledger does not
    record."""
    spent: Seconds = {}
    recorded = [e.spent for e in events if isinstance(e, Evaluated | Refitted | GuardLooked)]
    for one in (one for parts in (*recorded, beside) for one in parts):
        add_seconds(spent, one.activity, one.wall, one.processor)
    return tuple(TimeSpent(one, *spent[one]) for one in Activity if one in spent)


def profile_lines(events: Sequence[Event], beside: Sequence[TimeSpent] = ()) -> list[str]:
    """Return the table: one line per activity, the total last."""
    results = [e for e in events if isinstance(e, Evaluated)]
    without = sum(not e.spent for e in results)
    spent = summed(events, beside)
    if without == len(results):
        return [f"profile  {ABSENT}: no experiment of this run has a profile"]
    total = sum(one.wall for one in spent)
    lines = [f"profile  {'wall s':>22} {'share':>7} {'processor s':>12}"]
    for one in spent:
        share = f"{100 * one.wall / total:.1f} %"
        lines.append(f"  {one.activity:<12} {one.wall:16.2f} {share:>7} {one.processor:12.2f}")
    known = {one.activity for one in spent}
    lines += [f"  {a:<12} {ABSENT:>16}" for a in _NOT_IN_LEDGER if a not in known]
    processor = sum(one.processor for one in spent)
    lines.append(f"  {'total':<12} {total:16.2f} {'':>7} {processor:12.2f}")
    if without:
        lines.append(f"  {without} of {len(results)} experiments: {ABSENT}")
    return lines


def profile_object(
    events: Sequence[Event], beside: Sequence[TimeSpent] = ()
) -> dict[str, dict[str, float]]:
    """Return the seconds by activity."""
    return {
        one.activity.value: {"wall": one.wall, "processor": one.processor}
        for one in summed(events, beside)
    }


# Official figures of a model, and its rank among the published ones.


def board_lines(board: Board) -> Iterator[str]:
    """Yield the official figures of the model to use, their ranks among the published ones, and the
    line for the submission form; nothing if the problem is not a benchmark."""
    if not board.entries and board.unit_is_outputs:
        return
    width = max((len(s.figure.name) for s in board.standings), default=0)
    for standing in board.standings:
        figure = standing.figure
        line = f"official {figure.name:<{width}} {figure.value:.4g} {board.unit}"
        yield f"{line}  {standing.words}".rstrip()
    if board.submission:
        yield f"submit   {board.submission}"


def board_object(board: Board) -> dict[str, Any]:
    """Return the same as JSON; empty if the problem is not a benchmark."""
    if not board.entries and board.unit_is_outputs:
        return {}
    figures = {
        s.figure.name: {
            "value": s.figure.value,
            "rank": s.rank if s.among > 1 else None,
            "among": s.among,
            "above": None if s.above is None else {"value": s.above_value, "result": s.above.words},
        }
        for s in board.standings
    }
    return {"official": {"unit": board.unit, "figures": figures, "submission": board.submission}}
