"""asia models: the model families that a candidate can import."""

from pathlib import Path
from typing import Annotated

import typer

from asia._text import nearest, say, say_lines
from asia.errors import UserError


def models(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One family.")] = None,
    problem: Annotated[
        str | None,
        typer.Option(help="Problem for the example; default this workspace's, else two_tanks_sim."),
    ] = None,
) -> None:
    """Print the model families, or one of them: options, training, an example."""
    from asia.agents.library.pages import family_page
    from asia.agents.library.registry import all_families
    from asia.interfaces.workspace.workspace import Workspace
    from asia.problem.load import load_problem
    from asia.search.agent_views import problem_facts

    rows = all_families()
    if name is None:
        width = max(len(row.name) for row in rows)
        for row in rows:
            say(f"{row.name:<{width}}  {row.use}")
        say("asia models NAME prints options, training and an example")
        return
    found = next((row for row in rows if row.name == name), None)
    if found is None:
        raise UserError(f"no model family '{name}'{nearest(name, [row.name for row in rows])}")
    # Those of the named problem, of this workspace, or of a built-in problem.
    place = Workspace.around(Path())
    if problem is None and place is not None and (place.folder / "problem.toml").is_file():
        problem = str(place.folder)
    facts = problem_facts(load_problem(problem or "two_tanks_sim"))
    say_lines(family_page(found, facts if found.suits(facts) else None), end="")
