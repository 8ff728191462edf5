"""Whole searches on records that are preprocessed, and on records with missing outputs."""

from pathlib import Path

import numpy as np
import pytest

import asia
from asia.data import Array
from asia.data.preprocess import Preparation
from asia.ledger.events import TestedModel as Recorded
from asia.ledger.run import Run
from asia.problem.create import init_problem

DELAY, STEP = 3, 0.1


def plant(seed: int, samples: int = 400) -> tuple[Array, Array]:
    """First order behind a delay, far from zero, in units that differ by four powers of ten."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=samples // 4 + 1), 4)[:samples]
    x = np.zeros(samples)
    for k in range(DELAY + 1, samples):
        x[k] = 0.95 * x[k - 1] + 0.05 * u[k - 1 - DELAY]
    y = 300.0 + 0.01 * (x + 0.01 * rng.normal(size=samples))
    return 5000.0 + 100.0 * u, y


def search(directory: Path, runs: Path) -> Run:
    return asia.run(asia.load_problem(directory), experiments=1, runs=runs)


def write(path: Path, u: Array, y: Array) -> Path:
    rows = (f"{a!r},{b!r}" for a, b in zip(u.tolist(), y.tolist(), strict=True))
    path.write_text("\n".join(["u,y", *rows]))
    return path


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("prepared")
    train, test = (write(folder / f"{n}.csv", *plant(n)) for n in (1, 2))
    init_problem(
        folder / "plant", train=[train], test=[test], inputs=["u"], outputs=["y"],
        sampling_time=STEP, preparation=Preparation("auto", 2, True, True),
    )  # fmt: skip
    text = (folder / "plant" / "problem.toml").read_text()
    short = text.replace("[budget]", "[budget]\nretests = 0")
    (folder / "plant" / "problem.toml").write_text(short)
    return search(folder / "plant", folder / "runs")


@pytest.mark.long
def test_simulations_come_in_recorded_units_and_at_their_samples(prepared: Run) -> None:
    u, y = plant(3)
    start, past_u, past_y = 60, 2 * 10 + DELAY, 2 * 10
    y_hat = asia.simulate(
        prepared.directory,
        u[start - past_u : start, None],
        y[start - past_y : start, None],
        u[start:, None],
    )
    assert isinstance(y_hat, np.ndarray)
    assert y_hat.shape == (len(u) - start, 1)
    tail = slice(0, -2 * DELAY)
    error = (y_hat[:, 0] - y[start:])[tail]
    spread = y[start:].std()
    assert np.sqrt((error**2).mean()) < 0.2 * spread
    # One sample earlier or later fits worse: the delay is undone where it was done.
    for shift in (-2, 2):
        moved = np.roll(y_hat[:, 0], shift) - y[start:]
        assert np.sqrt((moved[10:-10] ** 2).mean()) > np.sqrt((error[10:-10] ** 2).mean())


@pytest.mark.long
def test_the_test_is_opened_with_the_same_preprocessing(prepared: Run) -> None:
    opened = asia.unseal(prepared.directory).record
    ensemble = opened.ensemble
    assert isinstance(ensemble, Recorded)
    # In the unit of the records.
    assert 0.0 < ensemble.scores[0].value < 0.2 * plant(2)[1].std()
    assert opened.lengths == ((400 - DELAY) // 2 - 10,)
