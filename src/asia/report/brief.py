"""A run in a few lines of HTML, for notebooks."""

from base64 import b64encode
from pathlib import Path

from markupsafe import Markup

from asia._text import one_line
from asia.ledger.run import model_to_use, open_run
from asia.presentation.table import error_value
from asia.problem.load import load_lock
from asia.report.files import png_of
from asia.report.page.render import render


def brief_html(directory: Path) -> str:
    """The run in `directory` for a notebook: V, the model to use, the problem's equations and the
    simulation of held-out parts as a picture. Raises UserError when `directory` is not a run."""
    run = open_run(directory)
    problem = load_lock(directory / "problem.lock.toml")
    best, named = run.view.best, model_to_use(run.view)
    if best is None or best.score is None or named is None:
        return str(Markup("<p>Run {}: no candidate has a score.</p>").format(one_line(run.name)))
    fits = [fold.worst_fit for fold in best.score.folds if fold.worst_fit is not None]
    least = f", lowest fit index {min(fits):.1f} %" if fits else ""
    rows = (
        ("run", one_line(run.name)),
        ("best", f"#{best.number:02d} {one_line(best.proposed.title)}"),
        (run.view.v_name, f"{error_value(best.score.value)}{least}"),
        ("model to use", f"{named.model}. {one_line(named.reason)}"),
    )
    picture = b64encode(png_of(run, problem, "simulation", 80)).decode()
    return str(render("brief.html", rows=rows, physics=problem.physics, picture=picture))
