"""asia models: the model families that a candidate can import."""

from pathlib import Path
from typing import Annotated

import typer

from asia._text import nearest, say, say_lines
from asia.errors import UserError


def models(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Family or plant.")] = None,
    problem: Annotated[
        str | None,
        typer.Option(help="Problem for the example; default this workspace's, else two_tanks_sim."),
    ] = None,
) -> None:
    """Print the model families and the plants of the catalogue, or one of them: options, training,
    an example; equations."""
    from asia.agents.library.pages import family_page, plant_page
    from asia.agents.library.registry import all_families
    from asia.interfaces.workspace.workspace import Workspace
    from asia.plants.catalogue import catalogue
    from asia.problem.load import load_problem
    from asia.search.agent_views import problem_facts

    rows = all_families()
    if name is None:
        width = max(len(row.name) for row in rows)
        for row in rows:
            say(f"{row.name:<{width}}  {row.use}")
        say(f"plants   {', '.join(catalogue())}")
        say("asia models NAME prints options, training and an example, or equations of a plant")
        return
    found = next((row for row in rows if row.name == name), None)
    if found is None and name in catalogue():
        say_lines(plant_page(catalogue()[name]), end="")
        return
    if found is None:
        known = [*(row.name for row in rows), *catalogue()]
        raise UserError(f"no model family or plant '{name}'{nearest(name, known)}")
    # Those of the named problem, of this workspace, or of a built-in problem.
    place = Workspace.around(Path())
    if problem is None and place is not None and (place.folder / "problem.toml").is_file():
        problem = str(place.folder)
    facts = problem_facts(load_problem(problem or "two_tanks_sim"))
    say_lines(family_page(found, facts if found.suits(facts) else None), end="")
