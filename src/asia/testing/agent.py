"""Conformance suite for agents."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from asia.agents.view import Agent, AgentView, Facts, Proposal, Running, Trial, proposes_ahead
from asia.candidate import check_source, source_digest
from asia.data.trajectory import Signal, Trajectory
from asia.judge.scoring.residuals import Diagnostics
from asia.problem.physics import ParameterRange, Physics, Prior

EXPERIMENTS = 20


def check_agent(make: Callable[[], Agent]) -> None:
    """Drive an agent through made-up searches: with and without physics, one and several channels,
    whole records and windows, good, bad and failing outcomes. No candidate is run.

    Checked: proposals are a function of the view (a second agent gives the same, and the view may
    be presented again), candidates pass the static checks, none is proposed twice, hypothesis and
    expectation are there, titles fit on a line, parents exist. An agent that may be asked ahead of
    results is also driven with several experiments in flight.
    """
    for facts in _problems():
        for luck in ("mixed", "failing"):
            _drive(make, facts, luck, EXPERIMENTS)
        if proposes_ahead(make()):
            _drive(make, facts, "mixed", EXPERIMENTS // 2 + 2, in_flight=3)


def _drive(
    make: Callable[[], Agent], facts: Facts, luck: str, proposals: int, in_flight: int = 1
) -> None:
    """Ask for proposals while the last ones before have no result: none of them by default."""
    source = "def fit(trajectories, context):\n    raise RuntimeError('made up')\n"
    trials: tuple[Trial, ...] = ()
    running = (Proposal(source, "baseline", "baseline", "made up", "made up"),)
    for _ in range(proposals):
        if len(running) == in_flight:
            ending = luck if trials or luck == "failing" else "good"
            trials = (*trials, _outcome(running[0], len(trials) + 1, ending))
            running = running[1:]
        view = _view(facts, trials, running)
        first, second = make().propose(view), make().propose(view)
        assert first == second, "the proposal is not a function of the view"
        if first is None:
            return
        _check_proposal(first, view)
        running = (*running, first)


def _check_proposal(proposal: Proposal, view: AgentView) -> None:
    check_source(proposal.source)
    assert not view.is_known(proposal.source), f"'{proposal.title}' was proposed before"
    for field in ("family", "title", "hypothesis", "expected"):
        text = getattr(proposal, field)
        assert isinstance(text, str), f"{field} is not text"
        assert text.strip(), f"{field} is empty"
    assert "\n" not in proposal.title, "the title has several lines"
    assert len(proposal.title) <= 80, f"the title is longer than 80 characters: {proposal.title}"
    known = {trial.number for trial in view.trials}
    assert proposal.parent is None or proposal.parent in known, "the parent does not exist"


def _view(facts: Facts, trials: tuple[Trial, ...], proposals: tuple[Proposal, ...]) -> AgentView:
    running = tuple(
        Running(n, p.parent, p.family, p.title, p.hypothesis, p.expected, p.source)
        for n, p in enumerate(proposals, len(trials) + 1)
    )
    tried = {source_digest(t.source) for t in (*trials, *running)}
    return AgentView(
        facts=facts,
        seed=0,
        phase="explore" if len(trials) + len(running) < EXPERIMENTS // 3 else "refine",
        trials=trials,
        running=running,
        remaining=EXPERIMENTS + 1 - len(trials) - len(running),
        is_known=lambda source: source_digest(source) in tried,
    )


def _outcome(proposal: Proposal, number: int, luck: str) -> Trial:
    """A trial with numbers made up from the source, so that they repeat."""
    digest = hashlib.sha256(source_digest(proposal.source).encode()).digest()
    chance = digest[0] / 256
    value = 0.1 + digest[1] / 256
    failed = luck == "failing" or (luck == "mixed" and chance < 1 / 6)
    evidence = Diagnostics(
        train_error=value * (0.3 + 0.7 * digest[2] / 256),
        bias=digest[3] / 2560,
        whiteness=digest[4] / 256,
        input_correlation=digest[5] / 256,
        top_error=digest[6] / 100,
        bottom_error=digest[7] / 100,
        start_error=digest[8] / 100,
        curvature=digest[9] / 256,
    )
    return Trial(
        number=number,
        parent=proposal.parent,
        phase="explore",
        family=proposal.family,
        title=proposal.title,
        hypothesis=proposal.hypothesis,
        expected=proposal.expected,
        source=proposal.source,
        status="crash" if failed else "discard",
        value=None if failed else value,
        folds=() if failed else (value, value),
        failure="crash: made up" if failed else None,
        diagnostics=() if failed else (evidence, evidence),
    )


def _problems() -> Iterator[Facts]:
    single = _facts(1, 1)
    yield single
    yield replace(_facts(2, 2), symmetry={"odd": {"u1": "-u1", "y1": "-y1"}})
    yield replace(
        single,
        physics=Physics(
            states=("x1", "x2"),
            dynamics={"x1": "-a*x1 + u1", "x2": "x1 - a*x2"},
            parameters={"a": ParameterRange(0.01, 1.0)},
            observation={"y1": "x2"},
            priors={"a": Prior(0.1, 0.05, "made up")},
        ),
    )
    yield replace(
        _facts(2, 2),
        n_past_u=0,
        n_past_y=1,
        horizon=20,
        metric="mae",
        early_stopping="validation",
        groups=(("made up",),),
    )


def _facts(nu: int, ny: int) -> Facts:
    rng = np.random.default_rng(0)
    records = (Trajectory(rng.normal(size=(200, nu)), rng.normal(size=(200, ny)), 1.0, "made up"),)
    return Facts(
        description="made up",
        inputs=tuple(Signal(f"u{i + 1}") for i in range(nu)),
        outputs=tuple(Signal(f"y{i + 1}") for i in range(ny)),
        sampling_time=1.0,
        records=records,
        n_past_u=5,
        n_past_y=5,
    )
