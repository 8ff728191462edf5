"""A dry run fits and simulates made-up samples, and no measured ones."""

import numpy as np
import pytest

from asia.data import Trajectory
from asia.judge.evaluation.dry_runs import DryRun, allowed_seconds, made_up_fold
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, Group, ProtocolRule


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
def test_no_measured_value_is_in_a_made_up_record(
    lengths: tuple[int, ...], rule: ProtocolRule
) -> None:
    records = [record(n, 1e5 * i, f"r{i}") for i, n in enumerate(lengths)]
    fold = make_folds(records, rule)[0]
    short = made_up_fold(fold, rule)
    measured = set(np.concatenate([t.y[1:-1, 0] for t in records]).tolist())
    measured |= {-value for value in measured}
    ends = {t.y[k, 0] for t in short.train for k in (t.y.argmin(), t.y.argmax())}
    made_up = [*short.train, *short.held_out]
    values = set(np.concatenate([one.y[:, 0] for one in made_up]).tolist()) - ends
    assert not values & measured
    samples, of_samples = (sum(map(len, one.train)) for one in (short, fold))
    assert samples <= of_samples
    assert len(short.held_out) <= 64
    assert (short.scale > 0).all()
    if of_samples > 2000:
        assert samples < 0.3 * of_samples


def test_made_up_records_have_the_shapes_gaps_and_rough_ranges_of_the_training_records() -> None:
    rng = np.random.default_rng(1)
    y = 30.0 + 4.0 * rng.normal(size=(400, 2))
    missing = rng.random((400, 2)) < 0.3
    one = Trajectory(rng.random((400, 3)), y, 0.5, "tank", missing)
    fold = make_folds([one], ProtocolRule())[0]
    (made_up,) = made_up_fold(fold, ProtocolRule()).train
    assert (made_up.u.shape[1], made_up.y.shape[1], made_up.sampling_time) == (3, 2, 0.5)
    train = fold.train[0]
    assert (made_up.missing == train.missing[: len(made_up)]).all()
    for values, like, step in ((made_up.u, train.u, 0.03), (made_up.y, train.y, 0.4)):
        assert (values.min(axis=0) >= like.min(axis=0) - step).all()
        assert (values.max(axis=0) <= like.max(axis=0) + step).all()
        assert np.abs(values.mean(axis=0) - like.mean(axis=0)).max() < 10 * step
        assert (values.std(axis=0) > 5 * step).all()


def test_the_same_ranges_give_the_same_records() -> None:
    """The outputs decide through one or two digits of their ranges and nothing else."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=(300, 1)), rng.normal(size=(300, 1))
    first, second = (
        made_up_fold(make_folds([Trajectory(u, v, 1.0, "a")], ProtocolRule())[0], ProtocolRule())
        for v in (y, np.where(np.abs(y) < 2, y + 1e-4 * rng.normal(size=y.shape), y))
    )
    assert first.train[0].y.tobytes() == second.train[0].y.tobytes()


def test_the_estimate_leaves_compilation_as_it_is() -> None:
    found = DryRun(None, "", 300, 1200, 10.0, 4.0, 0.1, 120.0, 120.0)
    assert found.whole_fit_seconds() == pytest.approx(4.0 + 6.0 * 4)
    assert DryRun(None, "", 300, 1200, None, 4.0, 0.1, 120.0, 120.0).whole_fit_seconds() is None


def test_a_dry_run_never_takes_longer_than_a_try() -> None:
    assert [allowed_seconds(limit) for limit in (20.0, 3600.0)] == [20.0, 120.0]
