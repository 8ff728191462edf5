"""`feedback = "ladder"`: everywhere an agent reads V it reads what is told; the ledger has all."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents import AgentView, Proposal
from asia.agents._llm_problem import problem_text
from asia.agents._llm_search import search_text, task_of
from asia.cli._try import result_lines
from asia.errors import UserError
from asia.ledger import SearchView, open_run
from asia.mcp._answers import shown
from asia.problem.load import load_lock, load_problem, protocol_digest
from asia.search import RunDesk, prepare, search, with_early_stopping
from asia.search._program import program
from asia.search._workspace import write_views

from .toy import Scripted, arx, write_problem

LADDER = 'feedback = "ladder"\n'
ALMOST = arx(2).replace("return Model(weights)", "return Model(0.9999 * weights)")


class Watching(Scripted):
    """Keeps what it was shown."""

    seen: list[AgentView]

    def propose(self, view: AgentView) -> Proposal | None:
        self.seen.append(view)
        return super().propose(view)


def with_feedback(root: Path, text: str = LADDER) -> Path:
    problem = write_problem(root / "toy")
    path = problem / "problem.toml"
    path.write_text(path.read_text().replace("[protocol]\n", f"[protocol]\n{text}"))
    return problem


@pytest.fixture
def laddered(tmp_path: Path) -> tuple[SearchView, Path, list[AgentView]]:
    """arx(1), arx(2) far better, then two that are as good."""
    agent = Watching((arx(2), ALMOST, arx(3)))
    object.__setattr__(agent, "seen", [])
    ready = prepare(load_problem(with_feedback(tmp_path)), agent.name, seed=0, runs=tmp_path / "r")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    return view, ready.directory, agent.seen


def digits(view: SearchView) -> list[str]:
    """The start of every V, folds included, that nobody may see."""
    scores = [e.score for e in view.experiments if e.score]
    values = [v for s in scores for v in (s.value, *(f.value for f in s.folds))]
    return [f"{v:.5f}"[1:] for v in values]


def test_what_agents_see_is_what_is_told(
    laddered: tuple[SearchView, Path, list[AgentView]], tmp_path: Path
) -> None:
    view, directory, seen = laddered
    assert [e.result.status for e in view.finished if e.result] == [
        "keep", "keep", "discard", "discard",
    ]  # fmt: skip
    last = seen[-1]
    assert [t.folds for t in last.trials] == [(), (), ()]
    assert last.trials[1].value == last.trials[2].value
    desk = RunDesk(directory)
    results = desk.results()
    assert results[1].value == results[2].value == results[3].value == desk.standing().best_value
    assert {r.folds for r in results} == {()}
    (tmp_path / "folder").mkdir()
    opened = open_run(directory)
    write_views(tmp_path / "folder", opened.view, opened.store)
    told = [p.read_text() for p in (tmp_path / "folder").iterdir() if p.name != "best.py"]
    told += [repr(results), repr(desk.standing()), search_text(last, task_of(last, 3))]
    told += [shown(desk.run(), n).model_dump_json() for n in (1, 2, 3, 4)]
    told += [line for r in results for line in result_lines(r, desk.standing())]
    hidden = digits(view)
    assert len(hidden) == 12
    assert not [d for d in hidden for text in told if d in text]
    assert not any("folds )" in text for text in told)
    written = (directory / "ledger.jsonl").read_text()
    exact = [json.dumps(e.score.value) for e in view.experiments if e.score]
    assert all(v in written for v in exact)


def test_prompts_say_how_scores_are_told(
    laddered: tuple[SearchView, Path, list[AgentView]],
) -> None:
    _, directory, seen = laddered
    assert "told on a ladder" in problem_text(seen[-1].facts)
    assert "10%" in problem_text(seen[-1].facts)
    problem = load_lock(directory / "problem.lock.toml")
    assert problem.protocol.ladder == 0.1
    assert "told on a ladder" in program(problem, 3)
    exact = replace(problem, protocol=replace(problem.protocol, ladder=None))
    assert "ladder" not in program(exact, 3)


def test_an_exact_protocol_has_the_digest_it_had(tmp_path: Path) -> None:
    exact = load_problem(with_feedback(tmp_path, 'feedback = "exact"\n'))
    plain = load_problem(write_problem(tmp_path / "plain"))
    assert exact.protocol.ladder is None
    assert protocol_digest(exact) == protocol_digest(plain)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('feedback = "rounded"\n', "feedback"),
        ("ladder_step = 0.1\n", 'belongs to feedback = "ladder"'),
        (LADDER + "ladder_step = 1.0\n", "ladder_step"),
        (LADDER + 'early_stopping = "validation"\n', "keep one of them"),
    ],
)
def test_settings_that_do_not_go_together(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        load_problem(with_feedback(tmp_path, text))


def test_the_command_line_cannot_tell_what_the_ladder_hides(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="keep one of them"):
        with_early_stopping(load_problem(with_feedback(tmp_path)), "validation")
