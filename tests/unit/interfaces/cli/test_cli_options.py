"""Groups of options: typer sees one parameter a field, the command gets the groups."""

from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import typer

from asia.interfaces.cli import app
from asia.interfaces.cli.options import given, with_groups

from .conftest import Asia


@dataclass(frozen=True)
class Colours:
    paint: Annotated[str | None, typer.Option(help="What it is painted with.")] = None
    coats: Annotated[int, typer.Option(min=1)] = 2


def test_a_group_is_spread_and_put_together_again(capsys: pytest.CaptureFixture[str]) -> None:
    toy = typer.Typer()

    @toy.command()
    @with_groups
    def house(*, street: str, colours: Colours, floors: int = 1) -> None:
        """Build it."""
        print(street, colours, floors)

    run = typer.main.get_command(toy)
    names = [parameter.name for parameter in run.params]
    assert names[:4] == ["street", "paint", "coats", "floors"]
    assert run.help == "Build it."
    run(["--paint", "red", "Hill", "--floors", "3"], standalone_mode=False)
    assert capsys.readouterr().out == f"Hill {Colours('red')} 3\n"


def test_options_are_added_to_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    def house(*, street: str) -> None:
        """Build it."""
        print(street)

    def garden(command: Any, given: Any, *, trees: int = 0) -> None:
        """Plant it."""
        command()
        print(given, trees)

    toy = typer.Typer()
    toy.command()(with_groups(house, added=[garden]))
    run = typer.main.get_command(toy)
    assert run.help == "Build it.\n\nPlant it."
    run(["Hill", "--trees", "3"], standalone_mode=False)
    assert capsys.readouterr().out == "Hill\n{'street': 'Hill'} 3\n"


def test_what_was_given_is_what_differs_from_the_default() -> None:
    assert given(Colours()) == {}
    assert given(Colours("red", 3)) == {"paint": "red", "coats": 3}
    assert given(Colours("red", 3), leave_out=("paint",)) == {"coats": 3}


def test_commands_that_begin_a_search_have_the_same_options() -> None:
    main: Any = typer.main.get_command(app)
    commands = {"run": main.get_command(None, "run"), **main.get_command(None, "agent").commands}
    shared = {"experiments", "seed", "hours", "name", "early_stopping", "isolation", "runs"}
    for name in ("run", "workspace", "mcp", "config"):
        assert shared <= {parameter.name for parameter in commands[name].params}


@pytest.mark.parametrize(
    ("words", "owner"),
    [
        (("--temperature", 0.5), "llm"),
        (("--anonymous",), "llm"),
        (("--network",), "command:NAME"),
        (("--max-tokens", 5), "llm or command:NAME"),
    ],
)
def test_an_option_of_another_agent_is_refused(
    asia: Asia, words: tuple[object, ...], owner: str
) -> None:
    done = asia("run", "two_tanks_sim", *words)
    assert done.code == 2
    assert f"{words[0]} is for --agent {owner}, and the agent is 'expert'" in done.err
