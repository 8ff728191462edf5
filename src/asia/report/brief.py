"""A run in a few lines of HTML, for notebooks."""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path

from asia.ledger.run import model_to_use, open_run
from asia.ledger.text import error_value
from asia.ledger.view import Experiment
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.report.files import png_of
from asia.report.page.html import Html, equations, join, said, tag

_DPI = 80


def brief_html(directory: Path) -> str:
    """See `asia.report.brief_html`."""
    run = open_run(directory)
    problem = load_lock(directory / "problem.lock.toml")
    best, named = run.view.best, model_to_use(run.view)
    if best is None or named is None:
        return str(tag("p", f"Run {said(run.name)}: no candidate has a score."))
    rows = (
        ("run", said(run.name)),
        ("best", join((f"#{best.number:02d} ", said(best.proposed.title)))),
        (run.view.v_name, _value(best)),
        ("model to use", join((f"{named.model}. ", said(named.reason, 300)))),
    )
    lines = (tag("div", tag("b", name), ": ", text) for name, text in rows)
    picture = png_of(run, problem, "simulation", _DPI)
    image = tag(
        "img",
        src=f"data:image/png;base64,{b64encode(picture).decode()}",
        alt="Simulation of held-out parts by the best candidate",
        style="max-width:100%",
    )
    return str(tag("div", *lines, _equations(problem), image))


def _value(best: Experiment) -> str:
    assert best.score is not None
    fits = [fold.worst_fit for fold in best.score.folds if fold.worst_fit is not None]
    least = f", lowest fit index {min(fits):.1f} %" if fits else ""
    return f"{error_value(best.score.value)}{least}"


def _equations(problem: Problem) -> Html | None:
    if problem.physics is None:
        return None
    return tag("div", *(formula for _, formula in equations(problem.physics)))
