"""A dry run fits and simulates samples that the first fold trains on, and no others."""

import numpy as np
import pytest

from asia.data import Trajectory
from asia.judge.evaluation.dry_runs import DryRun, allowed_seconds, short_fold
from asia.problem.protocol import FoldRule, Group, ProtocolRule, make_folds


def record(length: int, first: float = 0.0, name: str = "a") -> Trajectory:
    values = first + np.arange(float(length))
    return Trajectory(-values, values, 1.0, name)


WINDOWS = ProtocolRule(kind="windows", horizon=20, past_inputs=0, past_outputs=1)


@pytest.mark.parametrize(
    ("lengths", "rule"),
    [
        ((1200,), ProtocolRule()),
        ((150,), ProtocolRule()),
        ((40_000,), WINDOWS),
        ((900, 700, 400, 300), WINDOWS),
        (
            (400, 500),
            ProtocolRule(
                folds=FoldRule("leave_one_group_out", 2, (Group("x", ("r0",)), Group("y", ("r1",))))
            ),
        ),
    ],
)
def test_only_samples_that_train_are_cut(lengths: tuple[int, ...], rule: ProtocolRule) -> None:
    records = [record(n, 1e5 * i, f"r{i}") for i, n in enumerate(lengths)]
    fold = make_folds(records, rule)[0]
    trains = set(np.concatenate([t.y[:, 0] for t in fold.train]).tolist())
    held_out = set(np.concatenate([b.y[:, 0] for b in fold.validation]).tolist())
    short = short_fold(fold, rule)
    fitted = set(np.concatenate([t.y[:, 0] for t in short.fold.train]).tolist())
    asked = set(np.concatenate([b.y[:, 0] for b in short.fold.validation]).tolist())
    assert asked <= fitted <= trains
    assert not fitted & held_out
    assert short.samples == len(fitted) <= short.of_samples == len(trains)
    assert len(short.fold.validation) <= 64
    assert (short.fold.scale > 0).all()
    if len(trains) > 2000:
        assert short.samples < 0.3 * len(trains)


def test_outputs_that_rest_at_first_are_not_cut_there() -> None:
    y = np.concatenate([np.zeros(900), np.arange(1100.0)])
    fold = make_folds([Trajectory(y, y, 1.0, "late")], ProtocolRule(folds=FoldRule(count=4)))[0]
    assert np.ptp(short_fold(fold, ProtocolRule()).fold.train[0].y) > 0


def test_the_estimate_leaves_compilation_as_it_is() -> None:
    found = DryRun(None, "", 300, 1200, 10.0, 4.0, 0.1, 120.0, 120.0)
    assert found.whole_fit_seconds() == pytest.approx(4.0 + 6.0 * 4)
    assert DryRun(None, "", 300, 1200, None, 4.0, 0.1, 120.0, 120.0).whole_fit_seconds() is None


def test_a_dry_run_never_takes_longer_than_a_try() -> None:
    assert [allowed_seconds(limit) for limit in (20.0, 3600.0)] == [20.0, 120.0]
