"""A run in a few lines of HTML, for notebooks."""

from base64 import b64encode
from pathlib import Path

from asia.ledger.run import model_to_use, open_run
from asia.ledger.text import error_value
from asia.problem.load import load_lock
from asia.report.files import png_of
from asia.report.page.html import equations, join, said, tag


def brief_html(directory: Path) -> str:
    """The run in `directory` for a notebook: V, the model to use, the problem's equations and the
    simulation of held-out parts as a picture. Raises UserError when `directory` is not a run."""
    run = open_run(directory)
    problem = load_lock(directory / "problem.lock.toml")
    best, named = run.view.best, model_to_use(run.view)
    if best is None or best.score is None or named is None:
        return str(tag("p", f"Run {said(run.name)}: no candidate has a score."))
    fits = [fold.worst_fit for fold in best.score.folds if fold.worst_fit is not None]
    least = f", lowest fit index {min(fits):.1f} %" if fits else ""
    rows = (
        ("run", said(run.name)),
        ("best", join((f"#{best.number:02d} ", said(best.proposed.title)))),
        (run.view.v_name, f"{error_value(best.score.value)}{least}"),
        ("model to use", join((f"{named.model}. ", said(named.reason, 300)))),
    )
    lines = [tag("div", tag("b", name), ": ", text) for name, text in rows]
    if problem.physics is not None:
        lines.append(tag("div", *(formula for _, formula in equations(problem.physics))))
    picture = png_of(run, problem, "simulation", 80)
    image = tag(
        "img",
        src=f"data:image/png;base64,{b64encode(picture).decode()}",
        alt="Simulation of held-out parts by the best candidate",
        style="max-width:100%",
    )
    return str(tag("div", *lines, image))
