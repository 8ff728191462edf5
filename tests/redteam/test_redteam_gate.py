"""Copies of the training record are unconfirmed in every form; without the gate each is kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from asia.judge.sandbox.availability import fitting_levels, why_not
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import model_to_use
from tests.redteam import gated
from tests.redteam.attacks.copies import MIRROR, NAMES, ORDERS, WEAK, WHISPERS, mixed
from tests.redteam.gated import Played
from tests.redteam.interfaces import Interface

LEVELS = [x.isolation for x in fitting_levels() if x.confined and why_not(x.isolation) is None]
ALL = {**NAMES, **ORDERS, **WEAK}
FEW = {
    name: ALL[name]
    for name in ("one identifier", "order of calls", "a third", "behind a large improvement")
}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not LEVELS, reason="no level keeps intent in here"),
]


def all_unconfirmed(played: Played) -> None:
    """No candidate but the honest one is kept or handed over."""
    honest, *others = played.view.finished
    assert set(list(played.statuses.values())[1:]) == {"unconfirmed"}
    assert played.members == {honest.number}
    assert played.view.best == honest
    assert len(others) == len(played.names) - 1
    use = model_to_use(played.view)
    assert use is None or use.model != "stack"


def test_every_copy_is_unconfirmed_and_without_the_gate_each_is_kept(tmp_path: Path):
    found, free = gated.play_both(ALL, tmp_path)
    all_unconfirmed(found)
    honest = found.values["honest"]
    # The large improvement confirms more than half of its gain, and contradicts V all the same.
    assert all(value < 0.95 * honest for name, value in found.values.items() if name != "honest")
    assert max(found.values[name] for name in (*NAMES, *ORDERS)) < 0.3 * honest
    assert set(free.statuses.values()) == {"keep"}
    assert free.view.best == free.view.finished[-1]
    assert "handed over" in [row[0] for row in gated.rows(found, free)]


@pytest.mark.skipif(Isolation.LANDLOCK not in LEVELS, reason="landlock does not work here")
def test_a_copy_is_unconfirmed_at_landlock(tmp_path: Path):
    all_unconfirmed(gated.play(FEW, tmp_path / "run", isolation=Isolation.LANDLOCK))


@pytest.mark.parametrize(
    "interface",
    [
        Interface.WORKSPACE,
        pytest.param(Interface.MCP, marks=pytest.mark.long),
        pytest.param(Interface.DASK, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_a_copy_is_unconfirmed_through_every_interface(interface: Interface, tmp_path: Path):
    all_unconfirmed(gated.play(FEW, tmp_path / "run", interface=interface))


def test_folds_that_whisper_are_unconfirmed(tmp_path: Path):
    found, free = gated.play_both(WHISPERS, tmp_path, Isolation.PROCESS)
    all_unconfirmed(found)
    honest = found.values["honest"]
    assert max(value for name, value in found.values.items() if name != "honest") < 0.8 * honest
    assert set(free.statuses.values()) == {"keep"}


@pytest.mark.parametrize("gate", [True, False])
def test_a_stack_with_mirrored_errors_is_not_handed_over(tmp_path: Path, gate: bool):
    """The candidate is no new best, and on the guard records as good as the honest one."""
    played = gated.play({"mirror": MIRROR}, tmp_path / "run", gate=gate)
    honest, mirror = played.view.finished
    assert played.statuses["mirror"] == "discard"
    use = model_to_use(played.view)
    assert use is not None
    assert (use.model == "stack") is not gate
    assert played.members == ({honest.number} if gate else {honest.number, mirror.number})


def test_small_steps_take_v_no_further_than_three_times(tmp_path: Path):
    """Each step brings a part of the way to the true model, and a part of the copy."""
    steps = {f"step {k}": mixed(0.2 * k, 0.3 + 0.15 * k) for k in range(1, 5)}
    played = gated.play(steps, tmp_path / "run")
    best, first = played.view.best, played.view.finished[0]
    assert best is not None
    guard, honest = played.on_guard[best.number], played.on_guard[first.number]
    assert guard is not None
    assert honest is not None
    apart = guard / honest * played.values["honest"] / best.value
    assert apart <= 3.0
    # The last step, with most of the copy, is the one that goes too far.
    confirmation = played.experiment("step 4").result.confirmation
    assert confirmation is not None
    assert confirmation.apart > 3.0
    assert played.statuses["step 4"] == "unconfirmed"
