"""PROGRAM.md and models.md: what they must say, and in how many lines."""

import csv
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.agents.library.pages import families_page
from asia.candidate import check_source
from asia.interfaces.workspace.program import Confinement, models_page, program
from asia.judge.evaluation.fold_fits import search_context
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.agent_views import problem_facts
from tests.unit.search.toy import write_problem

PROBLEMS = Path(__file__).parents[5] / "src" / "asia" / "problems"
RECORDS = {
    "cascaded_tanks": (("train.csv", 1024),),
    "nanodrone": tuple((f"{kind}_{k}.csv", 2500) for kind in ("chirp", "random", "square")
                       for k in (1, 2)),
}  # fmt: skip
SOURCES = {
    "cascaded_tanks": 'source = "benchmark:cascaded_tanks"',
    "nanodrone": 'source = "nanodrone"',
}
FACTS = problem_facts(load_problem("two_tanks_sim"))
MOST_LINES = {"cascaded_tanks": 200, "nanodrone": 250}


def made_up(name: str, folder: Path) -> Problem:
    """The built-in problem, with random records of about its own lengths."""
    shutil.copytree(PROBLEMS / name, folder)
    path = folder / "problem.toml"
    text = path.read_text()
    assert SOURCES[name] in text
    files = ", ".join(f'"{file}"' for file, _ in RECORDS[name])
    path.write_text(text.replace(SOURCES[name], f"train = [{files}]"))
    names = {"cascaded_tanks": ["pump_voltage", "tank2_level"]}.get(name) or [
        *(f"m{k}_rads" for k in range(1, 5)),
        *("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "wx", "wy", "wz"),
    ]
    random = np.random.default_rng(0)
    for file, samples in RECORDS[name]:
        with (folder / file).open("w", newline="") as stream:
            table = csv.writer(stream)
            table.writerow(names)
            table.writerows(random.normal(size=(samples, len(names))).round(3).tolist())
    return load_problem(str(folder))


@pytest.mark.parametrize("name", ["cascaded_tanks", "nanodrone"])
@pytest.mark.parametrize("confinement", list(Confinement))
def test_both_pages_together_are_short(tmp_path: Path, name: str, confinement: Confinement) -> None:
    problem = made_up(name, tmp_path / name)
    lines = program(problem, 15, confinement) + models_page(problem)
    assert lines.count("\n") < MOST_LINES[name]


def test_the_program_has_the_facts_of_the_problem(tmp_path: Path) -> None:
    text = " ".join(program(made_up("cascaded_tanks", tmp_path / "p"), 15).split())
    for fact in (
        "14 are left for you",
        "the first 5 of each record",
        "past_u (B, 5, 1)",
        f"# python is {sys.executable}",
        "x1: 0 or more; x2: 0 to 10",
    ):
        assert fact in text, fact


@pytest.mark.parametrize("confinement", list(Confinement))
def test_the_first_line_says_what_is_open(tmp_path: Path, confinement: Confinement) -> None:
    first = program(load_problem("two_tanks_sim"), 5, confinement).splitlines()[0]
    jailed = confinement is not Confinement.OPEN
    assert first.startswith("> **Jail" if jailed else "> **Open folder, no jail.**")


def test_the_page_of_models_explains_every_option_and_holds_a_candidate() -> None:
    page = models_page(load_problem("two_tanks_sim"))
    check_source(page.split("```python\n")[1].split("```")[0])
    section = page.split("## greybox.Config\n")[1].split("\n## ")[0]
    for option in ("saturation", "spill", "sensor", "lag", "smooth", "prior_width", "priors"):
        assert f"- `{option}=" in section
    assert "| `linear` |" in page
    # A family that needs measured states is none for this problem.
    assert "physics_net" not in page


@pytest.mark.slow
def test_the_equations_of_the_page_are_a_candidate(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    example = models_page(problem).split("## Equations of your own")[1]
    source = example.split("```python\n")[1].split("```")[0]
    check_source(source)
    candidate: dict[str, Any] = {}
    exec(source, candidate)
    model = candidate["fit"](list(problem.train), search_context(problem, 0))
    assert model.parameters().keys() == {"d", "k", "g"}


def test_without_equations_greybox_is_first_and_its_integration_is_explained(
    tmp_path: Path,
) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    page = " ".join(models_page(problem).split())
    first = page.split("|---|---|---|---|")[1]
    assert first.startswith(" | `greybox` | equations of your own")
    for fact in ("Runge-Kutta steps of order 4", "zero-order hold", "`constants={NAME: VALUE}`"):
        assert fact in page
    assert "`greybox` | equations of your own" not in models_page(load_problem("two_tanks_sim"))


def test_the_program_says_what_a_try_costs_and_how_the_evaluator_ends() -> None:
    problem = load_problem("two_tanks_sim")
    page = " ".join(program(problem, 5).split())
    for fact in (
        "from up to 2 other seeds",
        "**keep**: ",
        "**best**: ",
        "asia steer --stop",
        "different minima",
    ):
        assert fact in page
    assert "asia steer" not in program(problem, 5, Confinement.JAIL)
    once = replace(problem, budget=replace(problem.budget, retests=0))
    assert "other seeds" not in program(once, 5)


def test_where_equations_are_given_the_page_says_how_to_change_them() -> None:
    page = program(load_problem("two_tanks_sim"), 5)
    assert 'dynamics={**context.physics.dynamics, "x1": "..."}' in " ".join(page.split())


def test_the_score_on_the_held_out_part_is_explained_where_there_is_one() -> None:
    facts = problem_facts(load_problem("two_tanks_sim"))
    assert "validation_score" not in families_page(facts)
    assert "validation_score" in families_page(replace(facts, early_stopping="validation"))
