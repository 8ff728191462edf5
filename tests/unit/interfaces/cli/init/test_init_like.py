"""asia init --like writes the equations of a plant into a problem."""

from pathlib import Path

from asia.problem.load import load_problem
from tests.unit.interfaces.cli.conftest import Asia


def test_a_problem_gets_the_equations_of_a_plant(problem: Path, asia: Asia) -> None:
    done = asia("init", problem, "--like", "tank")
    assert done.code == 0, done.err
    assert "inflow is u, level is y" in done.out
    physics = load_problem(problem).physics
    assert physics is not None
    assert physics.dynamics == {"level": "gain*u - outflow*sqrt(level)"}
    again = asia("init", problem, "--like", "tank")
    assert again.code == 2
    assert "remove [physics]" in again.err


def test_what_the_user_wrote_stays(problem: Path, asia: Asia) -> None:
    path = problem / "problem.toml"
    text = path.read_text()
    example = '# [physics]   # equations you trust\n# states = ["x"]\n'
    first, tables = text.split("\n[", 1)
    path.write_text(f"{first}\n{example}\n# my remark\n[{tables}")
    before = load_problem(problem)
    assert asia("init", problem, "--like", "tank").code == 0
    written = path.read_text()
    assert example not in written
    assert f"# my remark\n[{tables}".strip() in written
    after = load_problem(problem)
    assert (after.inputs, after.protocol, after.budget) == (
        before.inputs, before.protocol, before.budget
    )  # fmt: skip


def test_a_plant_that_does_not_fit_is_refused(problem: Path, asia: Asia) -> None:
    done = asia("init", problem, "--like", "quadruple_tank")
    assert done.code == 2
    assert "cannot fill the roles of a quadruple tank (inputs: pump_1, pump_2;" in done.err
    assert load_problem(problem).physics is None
    done = asia("init", problem, "--like", "quadruple_tnak")
    assert done.code == 2
    assert "did you mean 'quadruple_tank'" in done.err


def test_models_prints_a_plant(asia: Asia) -> None:
    assert "quadruple_tank" in asia("models").out
    shown = asia("models", "tank").out
    assert "Seborg" in shown
    assert 'level = "gain*inflow - outflow*sqrt(level)"' in shown
