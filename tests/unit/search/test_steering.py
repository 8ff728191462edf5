"""A person's word to a search that runs."""

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from asia.agents import AgentView, Proposal
from asia.errors import UserError
from asia.ledger.chain import Chain
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from asia.search.steering import (
    RunningLosses,
    Steering,
    note_for_people,
    running_losses,
)

from .toy import arx, write_problem


@dataclass
class Attentive:
    """Proposes lags one after the other and keeps the notes it saw; `before` is called first."""

    steering: Steering
    say: dict[int, str] = field(default_factory=dict[int, str])
    seen: list[tuple[str, ...]] = field(default_factory=list[tuple[str, ...]])
    name: str = "attentive"

    def propose(self, view: AgentView) -> Proposal | None:
        self.seen.append(view.notes)
        number = len(view.trials)
        word = self.say.get(number)
        if word == "stop":
            self.steering.stop()
        elif word == "pause":
            self.steering.pause()
        elif word and word.startswith("for people: "):
            note_for_people(open_run(self.steering.directory), "Ada", word, number, ["later"])
        elif word:
            self.steering.steer(word)
        return Proposal(arx(number + 1), "arx", f"{number + 1} lags", "more lags", "less error")


def go(problem: Path, agent: Attentive, runs: Path) -> SearchView:
    ready = prepare(load_problem(problem), agent.name, seed=0, runs=runs)
    return search(ready, agent, lambda event, view: None, lambda view: None)


@pytest.mark.slow
def test_a_note_is_recorded_and_seen_from_the_next_step_on(tmp_path: Path) -> None:
    problem, runs = write_problem(tmp_path / "toy"), tmp_path / "runs"
    agent = Attentive(Steering(runs / "toy-attentive-s0"), {2: "the valve sticks"})
    view = go(problem, agent, runs)
    assert agent.seen == [(), (), ("the valve sticks",)]
    assert [note.text for note in view.notes] == ["the valve sticks"]
    assert not agent.steering.waiting
    # The losses of the fits, which nothing shows once the fits are over.
    curves = json.loads((agent.steering.folder / "losses.json").read_text())
    assert set(curves[view.experiments[0].proposed.digest]) == {"1", "2"}
    assert running_losses(agent.steering.directory, view) == {}


@pytest.mark.long
def test_a_note_for_people_during_a_search_is_recorded_and_no_agent_sees_it(tmp_path: Path) -> None:
    problem, runs = write_problem(tmp_path / "toy"), tmp_path / "runs"
    directory = runs / "toy-attentive-s0"
    agent = Attentive(Steering(directory), {1: "for people: noisy", 3: "for people: the last"})
    view = go(problem, agent, runs)
    assert agent.seen == [()] * 3
    assert [(one.experiment, one.text) for one in view.noted] == [
        (1, "for people: noisy"),
        (3, "for people: the last"),
    ]
    assert (view.tags(1), view.tags(2), view.complete) == (("later",), (), True)
    assert verify(directory).records == len(open_run(directory).lines)
    again = open_run(directory)
    with Chain(directory / "ledger.jsonl"):
        assert not note_for_people(again, "Ada", "while another process writes", 2, ["good"])
    assert note_for_people(again, "Ada", "not so good", 1, ["good"], ["later"])
    view = open_run(directory).view
    assert [one.text for one in view.noted[2:]] == ["while another process writes", "not so good"]
    assert (view.tags(1), view.tags(2), view.complete) == (("good",), ("good",), True)


@pytest.mark.slow
def test_a_stopped_search_goes_on_by_the_same_call(tmp_path: Path) -> None:
    problem, runs = write_problem(tmp_path / "toy"), tmp_path / "runs"
    agent = Attentive(Steering(runs / "toy-attentive-s0"), {1: "stop"})
    view = go(problem, agent, runs)
    assert view.stopped is not None
    assert view.stopped.reason == "user"
    assert len(view.finished) == 2
    agent.say = {}
    view = go(problem, agent, runs)
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    assert len(view.finished) == 4


@pytest.mark.slow
def test_a_pause_holds_the_search_between_experiments(tmp_path: Path) -> None:
    problem, runs = write_problem(tmp_path / "toy"), tmp_path / "runs"
    steering = Steering(runs / "toy-attentive-s0")
    agent = Attentive(steering, {2: "pause"})
    thread = threading.Thread(target=go, args=(problem, agent, runs))
    thread.start()
    while not (steering.directory / "ledger.jsonl").is_file() or not steering.paused:
        time.sleep(0.02)
    time.sleep(1.5)
    held = len(open_run(steering.directory).view.experiments)
    assert held == 3
    steering.go_on()
    thread.join()
    assert len(open_run(steering.directory).view.experiments) == 4


def test_an_empty_note_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="1 to 4000 characters"):
        Steering(tmp_path).steer("  ")


def test_a_curve_of_losses_is_short_and_begins_again_with_another_fit(tmp_path: Path) -> None:
    losses = RunningLosses(tmp_path)
    for step in range(1000):
        losses("x = 1", 2, float(step), 1.0)
    (curve,) = (folds[2] for folds in losses.curves.values())
    assert (curve[0][0], curve[-1][0], len(curve) <= 101) == (0.0, 999.0, True)
    losses("x = 1", 2, 0.0, 7.0)
    assert curve == [(0.0, 7.0)]
