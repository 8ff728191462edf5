"""Lessons: what is learned from a search, what they weigh in the next, how they are kept."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents import AgentView, ExpertAgent, Proposal, Trial
from asia.agents.lessons import (
    FIRST_FIT,
    Lesson,
    LessonWeights,
    decode_lessons,
    encode_lessons,
    forget_lessons,
    keep_lessons,
    kept_lessons,
    kind_of,
    learn,
    merge,
    shipped_lessons,
    summaries,
    summary_lines,
)
from asia.agents.lessons.learn import move_named
from asia.agents.lessons.summary import MOST_LINES
from asia.agents.library.table import all_families, family
from asia.agents.llm.search import Task, search_text
from asia.errors import UserError
from asia.problem import Physics
from tests.unit.agents.searches import CLEAN, recipe_of, search, simulation, trial, view, windows

NONLINEAR = kind_of(simulation(physics=False), 0.5)
MOVE = "median of several fits"


def first_fit(name: str, number: int, value: float | None) -> Trial:
    row = family(name)
    assert row is not None
    source = row.trial(simulation(physics=False)).source("")
    return trial(Proposal(source, name, row.label, "", ""), number, value)


def refined(at: Trial, move: str, number: int, value: float | None) -> Trial:
    """A trial made from another by a move, as its title says."""
    row = family(at.family)
    assert row is not None
    source = recipe_of(at).trained(ridge=number / 100).source("")
    title = f"{row.label}: {move}"
    return trial(Proposal(source, at.family, title, "", "", at.number), number, value)


def now(*trials: Trial, lessons: tuple[Lesson, ...] = (), phase: str = "refine") -> AgentView:
    seen = view(simulation(physics=False), trials, phase)
    return replace(seen, linear=0.5, lessons=lessons)


def lesson(family: str, move: str, gain: float | None, run: str = "a") -> Lesson:
    return Lesson(run, NONLINEAR, family, move, gain)


def weights(lessons: tuple[Lesson, ...]) -> LessonWeights:
    return LessonWeights(lessons, now())


def test_first_fits_are_compared_with_the_linear_model_and_moves_with_their_parent() -> None:
    start = first_fit("neural_ss", 1, 0.25)
    trials = (
        start,
        refined(start, "slow disturbance in the noise", 2, 0.5),
        refined(start, "static function at the output", 3, None),
        first_fit("ltc", 4, None),
    )
    found = learn(now(*trials), "run")
    assert [(one.family, one.move) for one in found] == [
        ("neural_ss", FIRST_FIT),
        ("neural_ss", "slow disturbance in the noise"),
        ("neural_ss", "static function at the output"),
        ("ltc", FIRST_FIT),
    ]
    assert [one.gain for one in found] == [
        pytest.approx(math.log(2)), pytest.approx(-math.log(2)), None, None,
    ]  # fmt: skip
    assert all(one.kind == NONLINEAR and one.run == "run" for one in found)


def test_a_state_in_the_name_of_a_move_is_not_learned() -> None:
    """It would be a name of the person's, and no other problem has it."""
    at = first_fit("neural_ss", 1, 0.3)
    found = learn(now(at, refined(at, "smooth correction of x7", 2, 0.2)))
    assert found[1].move == "smooth correction of {state}"
    assert "x7" not in encode_lessons(found).decode()


def test_what_is_no_move_teaches_nothing() -> None:
    at = first_fit("neural_ss", 1, 0.3)
    own = replace(at, number=2, source="def fit(t, c): ...\n", title="an idea", parent=1)
    assert len(learn(now(at, own, refined(at, "an idea", 3, 0.1)))) == 1


def test_the_kind_of_system_tells_how_far_a_linear_model_comes() -> None:
    facts = simulation(physics=True)
    assert {"physics", "parameters", "short", "nearly linear"} == kind_of(facts, 0.05)
    assert "partly linear" in kind_of(facts, 0.2)
    assert "far from linear" in kind_of(facts, 0.6)
    assert kind_of(windows(), None) == {"windows", "measured", "long"}


def test_what_helped_weighs_more_and_what_harmed_less() -> None:
    known = tuple(
        one
        for run in "abcd"
        for one in (lesson("narx", MOVE, 0.7, run), lesson("narx", "more starts", -0.2, run))
    )
    prior = LessonWeights(known, now())
    assert 1.3 < prior.multiplier("narx", MOVE) <= 2.0
    assert 0.5 <= prior.multiplier("narx", "more starts") < 0.7
    assert 1.0 < prior.multiplier("esn", MOVE) < prior.multiplier("narx", MOVE)
    assert prior.multiplier("narx", "never made") == 1.0
    assert prior.multiplier("narx", FIRST_FIT) == 1.0
    assert LessonWeights((), now()).multiplier("narx", MOVE) == 1.0


def test_few_lessons_and_lessons_of_other_kinds_say_little() -> None:
    other = (
        lesson("esn", "less ridge", 0.6, "x"),
        *(lesson("narx", "more starts", 0.3, "x"),) * 40,
    )
    prior = [
        LessonWeights((*other, *(lesson("narx", MOVE, 0.6),) * count), now()).multiplier(
            "narx", MOVE
        )
        for count in (1, 3, 9)
    ]
    assert 1.0 < prior[0] < prior[1]
    far = replace(lesson("narx", MOVE, 0.6), kind=frozenset({"windows", "long"}))
    assert 1.0 < LessonWeights((*other, far), now()).multiplier("narx", MOVE) < prior[0]


def test_a_search_that_goes_against_its_lessons_trusts_them_less() -> None:
    wrong = tuple(
        one
        for run in "abcd"
        for one in (
            lesson("esn", FIRST_FIT, 2.0, run),
            lesson("neural_ss", FIRST_FIT, -1.0, run),
        )
    )
    assert LessonWeights(wrong, now()).trust == 1.0
    against = now(first_fit("neural_ss", 1, 0.05), first_fit("esn", 2, 0.6))
    assert LessonWeights(wrong, against).trust == 0.5
    agreeing = now(first_fit("esn", 1, 0.05), first_fit("neural_ss", 2, 0.6))
    assert LessonWeights(wrong, agreeing).trust == 1.0
    before = LessonWeights(wrong, now()).multiplier("esn", FIRST_FIT)
    assert 1.0 < LessonWeights(wrong, against).multiplier("esn", FIRST_FIT) < before


def test_the_expert_tries_first_what_helped_elsewhere() -> None:
    without = ExpertAgent().propose(now(phase="explore"))
    known = tuple(
        one
        for run in "abcdefgh"
        for one in (
            lesson("block_oriented", FIRST_FIT, 2.0, run),
            *(lesson(n, FIRST_FIT, -1.0, run) for n in ("neural_ss", "linear", "ltc")),
        )
    )
    taught = ExpertAgent().propose(now(phase="explore", lessons=known))
    assert without is not None
    assert taught is not None
    assert without.family != "block_oriented"
    assert taught.family == "block_oriented"


def test_what_its_own_residuals_show_is_not_held_back_by_lessons() -> None:
    """A move that interrupts the ladder without lessons does so with bad ones."""
    facts = simulation(physics=True)
    first = ExpertAgent().propose(view(facts, (), "explore"))
    assert first is not None
    seen = view(facts, (trial(first, 1, 0.3, replace(CLEAN, top_error=2.0)),), "explore")
    plain = ExpertAgent().propose(seen)
    assert plain is not None
    assert plain.parent == 1
    sure = move_named(plain.title.removeprefix("grey-box: "))
    assert sure is not None
    bad = tuple(
        Lesson(run, kind_of(facts, None), first.family, move, gain)
        for run in "abcdefgh"
        for move, gain in ((sure, -2.0), ("more starts", 1.0))
    )
    assert LessonWeights(bad, seen).multiplier(first.family, sure) == 0.5
    assert ExpertAgent().propose(replace(seen, lessons=bad)) == plain


def test_lessons_of_no_use_leave_the_search_as_it_is() -> None:
    """Of moves that all brought the same, and of families with the first as the best."""
    facts = simulation(physics=True)
    plain = search(ExpertAgent, facts, 12)
    known = (Lesson("a", frozenset({"windows"}), "a family elsewhere", "a move elsewhere", 0.1),)

    class Taught(ExpertAgent):
        def propose(self, view: AgentView) -> Proposal | None:
            return super().propose(replace(view, lessons=known))

    assert search(Taught, facts, 12) == plain


def test_ten_lines_for_a_language_model() -> None:
    names = [row.name for row in all_families()]
    known = tuple(
        one
        for run in "abc"
        for name in names
        for one in (lesson(name, FIRST_FIT, 0.5, run), lesson(name, MOVE, 0.1, run))
    )
    lines = summary_lines(now(lessons=known))
    assert len(lines) == MOST_LINES
    assert all(line.count("\n") == 0 and len(line) < 200 for line in lines)
    assert any("against the best linear model" in line for line in lines)
    assert "V -39% (quartiles -39% to -39%), tried 3 times in 3 searches" in lines[0]
    assert summary_lines(now()) == ()


def test_a_language_model_reads_them_only_where_there_are_any() -> None:
    known = (lesson("narx", FIRST_FIT, 0.5), lesson("narx", FIRST_FIT, 0.7, "b"))
    task = Task("explore")
    text = search_text(now(lessons=known), task)
    assert "# Lessons: what moves brought in earlier searches" in text
    assert "narx, first fit: V -45%" in text
    assert "Lessons" not in search_text(now(), task)


def test_a_summary_counts_failures_and_has_the_spread() -> None:
    gains = (math.log(2), 0.0, -math.log(2), None)
    (found,) = summaries([lesson("narx", MOVE, g, r) for g, r in zip(gains, "aabb", strict=True)])
    assert (found.count, found.failed, found.searches) == (4, 1, 2)
    assert (found.middle, found.low, found.high) == (
        pytest.approx(0.0), pytest.approx(-0.25), pytest.approx(0.5),
    )  # fmt: skip
    (none,) = summaries([lesson("narx", MOVE, None)])
    assert none.words == "tried 1 times in 1 searches, no score"


def test_a_search_that_is_learned_again_takes_the_place_of_its_old_lessons() -> None:
    old = (lesson("narx", MOVE, 0.1, "a"), lesson("narx", MOVE, 0.2, "b"))
    new = (lesson("narx", MOVE, 0.3, "b"), lesson("esn", MOVE, 0.4, "b"))
    assert merge(old, new) == (old[0], *new)


def test_lessons_are_kept_and_forgotten(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ASIA_LESSONS", str(tmp_path / "kept"))
    assert kept_lessons() == ()
    known = (lesson("narx", MOVE, 0.25), lesson("esn", FIRST_FIT, None, "b"))
    assert keep_lessons(known) == known
    assert kept_lessons() == known
    assert encode_lessons(known) == (tmp_path / "kept" / "lessons.json").read_bytes()
    assert forget_lessons()
    assert kept_lessons() == ()
    assert not forget_lessons()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        '[["a", ["b"], [["c"]]]]',
        '[["a", ["b"], 3]]',
        '[["a", [], [["b", "c", NaN]]]]',
        '[["a", [], [["b", "c", 1e9]]]]',
    ],
)
def test_what_is_no_file_of_lessons_is_said(text: str) -> None:
    with pytest.raises(UserError, match=r"mine\.json holds no lessons: expected a file that"):
        decode_lessons(text.encode(), "mine.json")


def test_the_shipped_lessons_are_of_moves_and_families_that_there_are() -> None:
    """Written by benchmarks/searches/lessons.py; a renamed move makes it run again."""
    from asia.agents.expert.moves import all_moves

    found = shipped_lessons()
    assert encode_lessons(found) == (
        Path(kept_lessons.__code__.co_filename).with_name("shipped.json").read_bytes()
    )
    assert {one.family for one in found} <= {row.name for row in all_families()}
    assert {one.move for one in found} <= {FIRST_FIT, *(move.name for move in all_moves())}


def test_physics_do_not_stand_in_lessons() -> None:
    facts = simulation(physics=True)
    assert isinstance(facts.physics, Physics)
    text = encode_lessons(learn(now(*search(ExpertAgent, facts, 10)))).decode()
    for word in ("x1", "x2", '"u"', '"y"'):
        assert word not in text
