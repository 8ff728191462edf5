"""`feedback = "ladder"`: an agent reads only the reported V; the ledger has all."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from asia.agents import AgentView, Proposal
from asia.agents.llm.prompt import problem_text, search_text, task_of
from asia.errors import Reason, UserError
from asia.interfaces.cli.agent import result_lines
from asia.interfaces.mcp.server import source_answer
from asia.interfaces.workspace.program import program
from asia.interfaces.workspace.server import RunDesk
from asia.interfaces.workspace.workspace import write_views
from asia.judge.evaluation import evaluator as evaluator_module
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.relations import Suspicion, SuspicionKind
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import protocol_digest
from asia.search.decision import Decision, decide_by_one_fit
from asia.search.fair_trial import Tried
from asia.search.run import prepare, search, with_early_stopping
from tests.redteam import arena
from tests.redteam.attacks import probing

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


@pytest.fixture(scope="module")
def laddered(tmp_path_factory: pytest.TempPathFactory) -> tuple[SearchView, Path, list[AgentView]]:
    """arx(1), arx(2) far better, then two that are as good."""
    agent = Watching((arx(2), ALMOST, arx(3)))
    object.__setattr__(agent, "seen", [])
    root = tmp_path_factory.mktemp("laddered")
    ready = prepare(load_problem(with_feedback(root)), agent.name, seed=0, runs=root / "r")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    return view, ready.directory, agent.seen


def digits(view: SearchView) -> list[str]:
    """The start of every V, folds included, that nobody may see."""
    scores = [e.score for e in view.experiments if e.score]
    values = [v for s in scores for v in (s.value, *(f.value for f in s.folds))]
    return [f"{v:.5f}"[1:] for v in values]


@pytest.mark.slow
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
    best = desk.progress().best
    assert best is not None
    assert results[1].V == results[2].V == results[3].V == best.V
    assert {r.folds for r in results} == {()}
    (tmp_path / "folder").mkdir()
    opened = open_run(directory)
    write_views(tmp_path / "folder", opened.view, opened.store)
    told = [p.read_text() for p in (tmp_path / "folder").iterdir() if p.name != "best.py"]
    told += [repr(results), repr(desk.progress()), search_text(last, task_of(last, 3))]
    told += [json.dumps(asdict(source_answer(desk.run(), n))) for n in (1, 2, 3, 4)]
    told += [line for r in results for line in result_lines(r, desk.progress())]
    hidden = digits(view)
    assert len(hidden) == 12
    assert not [d for d in hidden for text in told if d in text]
    assert not any("folds )" in text for text in told)
    written = (directory / "ledger.jsonl").read_text()
    exact = [json.dumps(e.score.value) for e in view.experiments if e.score]
    assert all(v in written for v in exact)


def told(directory: Path, number: int) -> str:
    """All that an agent can read of an experiment but its number, words and time."""
    run = RunDesk(directory).run()
    answer = asdict(source_answer(run, number))
    answer["training"] = len(answer["training"])
    result = answer["result"]
    keep = ("status", "V", "folds", "reason", "advice", "detail")
    return repr([answer["training"], *(result[key] for key in keep)])


FORGETFUL = """
class Forgetful(Model):
    calls, start = 0, None

    def simulate(self, past_u, past_y, u):
        # Counts anew for each case, so that the first answer to one is always the same.
        start = round(float(past_y[0, -1, 0]), 3)
        self.calls = self.calls + 1 if start == self.start else 1
        self.start = start
        return super().simulate(past_u, past_y, u) + SIZE * self.calls


def fit(trajectories, context):
    return Forgetful(train(trajectories, context).weights)
"""


def forgetful(order: int, size: float) -> str:
    honest = arx(order).replace("def fit(", "def train(")
    return honest + FORGETFUL.replace("SIZE", str(size))


@pytest.mark.slow
def test_a_verdict_is_the_same_whether_or_not_it_would_have_won(tmp_path: Path) -> None:
    agent = Scripted((forgetful(2, 0.01), forgetful(1, 0.02)))
    ready = prepare(load_problem(with_feedback(tmp_path)), agent.name, seed=0, runs=tmp_path / "r")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    winning, losing = (view.experiment(n).failure for n in (2, 3))
    assert winning is not None
    assert losing is not None
    assert winning.reason is losing.reason is Reason.SUSPECT
    assert winning.fold == losing.fold
    # The relations that a random choice of cases breaks are no matter of V.
    words = [
        told(ready.directory, number).replace(failure.detail, "")
        for number, failure in ((2, winning), (3, losing))
    ]
    assert words[0] == words[1]


@pytest.mark.slow
def test_a_verdict_from_held_out_outputs_is_told_as_no_new_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = (Suspicion(SuspicionKind.RESTART, "far worse", 9.0),)
    calls = iter([(), (), broken, broken])
    monkeypatch.setattr(evaluator_module, "suspicions", lambda *a, **named: next(calls, ()))
    agent = Scripted((arx(2), arx(1).replace("n = 1", "n = 1 + 0")))
    ready = prepare(load_problem(with_feedback(tmp_path)), agent.name, seed=0, runs=tmp_path / "r")
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    failure = view.experiment(2).failure
    assert failure is not None
    assert failure.reason is Reason.RESTART
    assert view.best is not None
    assert view.best.number == 1
    assert told(ready.directory, 2) == told(ready.directory, 3)


def judged_as_without_the_ladder(
    evaluator: Evaluator,
    source: str,
    view: SearchView,
    first: Tried | None = None,
    proposed: object = None,
    confirm: object = None,
    store: object = None,
) -> Decision:
    """Only a would-be best candidate is doubted."""
    del first, proposed, confirm, store
    evaluation = evaluator.evaluate(source)
    assert isinstance(evaluation.outcome, Score)
    if decide_by_one_fit(evaluation.outcome, view) != "keep":
        return Decision(Tried(source, evaluation), "discard")
    outcome = evaluator.objection(source, ()) or evaluation.outcome
    tried = Tried(source, replace(evaluation, outcome=outcome))
    return Decision(tried, decide_by_one_fit(outcome, view))


@pytest.mark.parametrize(
    ("spoil", "part", "otherwise"),
    [
        (arena.forgetful, "decide", judged_as_without_the_ladder),
        (arena.one_start(0.35), "published", lambda view: view),
    ],
)
def test_spoilt_candidates_tell_nothing(
    spoil: Callable[[Score], Failure | None],
    part: str,
    otherwise: object,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ladder = probing.Ladder(spoil)
    start = probing.exact(np.zeros_like(probing.hidden_error()))
    assert probing.exact(probing.bisect(ladder.ask, ladder.doubt)) == start
    monkeypatch.setattr(arena, part, otherwise)
    leaking = probing.Ladder(spoil)
    assert probing.exact(probing.bisect(leaking.ask, leaking.doubt)) < 0.85 * start


@pytest.mark.slow
def test_prompts_say_how_scores_are_told(
    laddered: tuple[SearchView, Path, list[AgentView]],
) -> None:
    _, directory, seen = laddered
    assert "by the rule of the Ladder" in problem_text(seen[-1].facts)
    assert "10%" in problem_text(seen[-1].facts)
    problem = load_lock(directory / "problem.lock.toml")
    assert problem.protocol.ladder == 0.1
    assert "by the rule of the Ladder" in program(problem, 3)
    assert "causal in u" in problem_text(seen[-1].facts)
    assert "causal in u" in program(problem, 3)
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
