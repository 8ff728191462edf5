from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal, Trajectory, data_digest
from asia.data.preprocess import Preparation, Preprocess
from asia.data.segment import Segment
from asia.data.statistics import delays
from asia.errors import UserError
from asia.ledger.run import Run
from asia.problem.create import init_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Problem
from asia.problem.seal import open_test, seal
from asia.search import simulation

U = (Signal("u", "V"),)


def log(seed: int, samples: int = 600, delay: int = 3) -> Trajectory:
    """First order, driven by steps, with a delay and small noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=samples // 2), 2) + 5.0
    y = np.zeros(samples)
    for k in range(delay + 1, samples):
        y[k] = 0.8 * y[k - 1] + 0.2 * (u[k - 1 - delay] - 5.0)
    return Trajectory(u, y + 40.0 + 0.01 * rng.normal(size=samples), 0.1, f"log{seed}")


def write(record: Trajectory, folder: Path) -> Path:
    path = folder / f"{record.name}.csv"
    rows = [
        f"{float(a)!r},{float(b)!r}" for a, b in zip(record.u[:, 0], record.y[:, 0], strict=True)
    ]
    path.write_text("\n".join(["u,y", *rows]))
    return path


@pytest.fixture
def made(tmp_path: Path) -> Path:
    paths = [write(log(seed), tmp_path) for seed in (1, 2)]
    init_problem(
        tmp_path / "mill",
        train=paths[:1],
        test=paths[1:],
        inputs=["u"],
        outputs=["y"],
        sampling_time=0.1,
        preparation=Preparation("auto", 2, True, True),
    )
    return tmp_path / "mill"


def test_every_record_is_prepared_alike(made: Path) -> None:
    problem = load_problem(made)
    done = problem.preprocess
    assert dict(done.delay) == {"u": 3}
    assert done.detrend
    assert done.scale
    assert problem.sampling_time == 0.2
    (train,), (test,) = problem.train, open_test(problem)
    assert len(train) == len(test) == (600 - 3) // 2
    raw = log(2)
    assert test.u[4, 0] == pytest.approx(raw.u[8:10, 0].mean())
    assert test.y[4, 0] == raw.y[11, 0]
    assert seal(problem).lengths == (len(test),)


def test_the_lock_restores_it(made: Path, tmp_path: Path) -> None:
    problem = load_problem(made)
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)))
    again = load_lock(lock)
    assert again.preprocess == problem.preprocess
    assert data_digest(again.train) == data_digest(problem.train)
    assert data_digest(open_test(again)) == data_digest(open_test(problem))


def test_model_inputs_and_outputs(made: Path) -> None:
    """The block that `asia.simulate` makes of a record is the one that the search cuts."""
    problem: Problem = load_problem(made)
    raw, (test,) = log(2), open_test(problem)
    past = problem.protocol.past_inputs
    start = 3 + 2 * past
    run = type("Named", (), {"name": "run"})()
    assert not isinstance(run, Run)
    block = simulation._block(run, problem, raw.u[:start], raw.y[3:start], raw.u[start:])
    case: Segment = block
    count = len(test) - past
    assert np.array_equal(case.past_u, test.u[:past])
    assert np.array_equal(case.past_y, test.y[:past])
    assert np.allclose(case.u[:count], test.u[past:])
    back = problem.preprocess.refined(test.y[past:], 2 * count)
    assert back.shape == (2 * count, 1)
    assert np.allclose(back[::2], raw.y[start : start + 2 * count : 2])


def test_nothing_is_done_by_default() -> None:
    record = log(1)
    assert Preprocess().record(record, U) is record
    assert Preprocess(detrend=True).record(record, U) is record
    assert not Preprocess()


def test_wrong_tables_are_refused(made: Path) -> None:
    path = made / "problem.toml"
    text = path.read_text()
    path.write_text(text.replace("delay = { u = 3 }", "delay = { y = 3 }"))
    with pytest.raises(UserError, match=r"preprocess\.delay names 'y', expected one of u"):
        load_problem(made)
    path.write_text(text.replace("decimate = 2", "decimate = 0"))
    with pytest.raises(UserError, match=r"preprocess\.decimate is 0"):
        load_problem(made)
    for old in ("offset = { y = 40.0 }", "scale = { u = 1.0 }"):
        path.write_text(text.replace("scale = true", old))
        with pytest.raises(UserError, match="of an older version, with offset or scale in numbers"):
            load_problem(made)
    path.write_text(text + '[physics]\nstates = ["y"]\n[physics.dynamics]\ny = "u"\n')
    with pytest.raises(UserError, match=r"change the signals that \[physics\]"):
        load_problem(made)


@pytest.mark.parametrize("delay", [0, 1, 4, 20])
def test_delays_are_found(delay: int) -> None:
    found = delays([log(3, 2000, delay), log(4, 1000, delay)])[0][0]
    assert found is not None
    assert found.lag == delay + 1


def test_no_delay_is_found_where_nothing_answers() -> None:
    rng = np.random.default_rng(0)
    found = [
        delays([Trajectory(rng.normal(size=500), rng.normal(size=500), 1.0)])[0][0]
        for _ in range(40)
    ]
    assert sum(one is not None and one.lag is None for one in found) >= 38
