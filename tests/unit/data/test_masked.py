"""Outputs that were not measured: what a record holds, what folds show, what a score counts."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Array, Trajectory, data_digest
from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Wanted
from asia.errors import UserError
from asia.judge.scoring.euclidean_error import mee_table
from asia.judge.scoring.outcome import fit_index, score_fold, score_parts, score_test
from asia.problem.create import init_problem, record_csv
from asia.problem.folds import make_folds, whole
from asia.problem.load import load_problem
from asia.problem.metrics import find_metric
from asia.problem.protocol import FoldRule, OutputGroup, ProtocolRule

NAN = float("nan")


def record(y: Array | list[float], name: str = "r") -> Trajectory:
    y = np.asarray(y, dtype=np.float64)
    return Trajectory(np.arange(len(y), dtype=np.float64), y, 1.0, name)


def masked(seed: int, samples: int = 120, outputs: int = 2) -> tuple[Trajectory, Trajectory]:
    """A record, and the same one with three in ten outputs taken away at random."""
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(samples, outputs)).cumsum(axis=0)
    lost = np.where(rng.random(y.shape) < 0.3, NAN, y)
    lost[0], lost[-1] = y[0], y[-1]
    u = rng.normal(size=(samples, 1))
    return Trajectory(u, y, 1.0, "r"), Trajectory(u, lost, 1.0, "r")


def test_a_gap_is_a_straight_line_and_known_as_a_gap() -> None:
    r = record([NAN, 1.0, NAN, NAN, 4.0, NAN])
    assert r.y[:, 0].tolist() == [1.0, 1.0, 2.0, 3.0, 4.0, 4.0]
    assert r.measured[:, 0].tolist() == [False, True, False, False, True, False]
    assert np.array_equal(r.measured_y[:, 0], [NAN, 1.0, NAN, NAN, 4.0, NAN], equal_nan=True)
    with pytest.raises(UserError, match="output 1 was never measured"):
        record([NAN, NAN])
    with pytest.raises(UserError, match="the value at sample 2, channel 1 is infinite"):
        record([0.0, np.inf])


def test_a_single_segment_is_filled_from_itself() -> None:
    r = record([0.0, 10.0, NAN, NAN, NAN, 50.0, NAN])
    assert r[1:4].y[:, 0].tolist() == [10.0, 20.0, 30.0]
    assert r.alone(1, 4).y[:, 0].tolist() == [10.0, 10.0, 10.0]


def test_without_a_gap_nothing_changes() -> None:
    full, lost = masked(0)
    assert full.missing is None
    assert full.measured.all()
    assert full.measured_y is full.y
    assert full.alone(3, 9).missing is None
    # The digest of a record as locks and ledgers of today hold it.
    plain = Trajectory(np.arange(3.0), np.arange(3.0), 0.5)
    assert data_digest([plain]).startswith("4774ec183c853cc8")
    assert data_digest([full]) != data_digest([lost])


@given(st.integers(0, 1000), st.integers(0, 3))
def test_no_held_out_output_reaches_training(seed: int, past: int) -> None:
    """Other held-out values leave the training records and the past windows before them alone."""
    _, one = masked(seed)
    rule = ProtocolRule(folds=FoldRule(count=3), past_inputs=past, past_outputs=past)
    for fold in make_folds([one], rule):
        block = fold.held_out[0]
        moved = one.measured_y.copy()
        moved[block.start : block.stop] += 100.0
        other = make_folds([Trajectory(one.u, moved, 1.0, "r")], rule)[fold.index]
        for a, b in zip(fold.train, other.train, strict=True):
            assert np.array_equal(a.y, b.y)
            assert a.missing is not None
        assert np.array_equal(block.past_y, other.held_out[0].past_y)
        assert np.isfinite(block.past_y).all()
        assert np.isnan(block.y).any()


def test_a_past_window_is_filled_from_before_it_begins() -> None:
    r = record([3.0, NAN, NAN, 8.0, 9.0])
    (block,) = whole([r], ProtocolRule(past_inputs=2, past_outputs=2))
    assert block.past_y[:, 0].tolist() == [3.0, 3.0]
    assert np.array_equal(block.y[:, 0], [NAN, 8.0, 9.0], equal_nan=True)
    burst = record([1.0, 2.0, *[NAN] * 4, 5.0, 6.0, 7.0, 8.0, *range(20)])
    (block,) = whole([burst], ProtocolRule(past_inputs=4, past_outputs=2))
    assert (block.start, block.past_y[:, 0].tolist()) == (8, [5.0, 6.0])
    late = record([NAN, NAN, NAN, 8.0, 9.0])
    (block,) = whole([late], ProtocolRule(past_inputs=2, past_outputs=2))
    assert (block.start, block.past_y[:, 0].tolist()) == (4, [8.0, 8.0])


def test_a_fold_without_a_measured_output_is_refused() -> None:
    y = np.sin(np.arange(60.0))
    y[26:45] = NAN
    with pytest.raises(UserError, match="never measured in what fold 2 holds out"):
        make_folds([record(y)], ProtocolRule(folds=FoldRule(count=3), past_inputs=2))


@pytest.mark.parametrize("metric", ["rmse", "mae"])
def test_scores_count_only_measured_samples(metric: str) -> None:
    full, lost = masked(3)
    rng = np.random.default_rng(7)
    y_hat = full.y + rng.normal(size=full.y.shape)
    scale = np.array([2.0, 3.0])
    known = lost.measured
    error = np.abs(full.y - y_hat)
    each = [
        np.sqrt((error[k, c] ** 2).mean()) if metric == "rmse" else error[k, c].mean()
        for c, k in enumerate(known.T)
    ]
    found = score_fold([lost.measured_y], [y_hat], scale, metric)
    assert found.value == pytest.approx(np.mean(each / scale))
    assert len(score_parts([lost.measured_y], [y_hat], scale, metric)) == 8
    test = score_test([lost.measured_y], [y_hat], metric, skip=0)
    assert test.per_channel == pytest.approx(each)
    wild = np.where(known, y_hat, 1e6)
    assert score_fold([lost.measured_y], [wild], scale, metric).value == pytest.approx(found.value)
    own = full.y[known[:, 0], 0], y_hat[known[:, 0], 0]
    energy = np.sum((own[0] - own[1]) ** 2) / np.sum((own[0] - own[0].mean()) ** 2)
    assert fit_index(lost.measured_y, y_hat)[0] == pytest.approx(100 * (1 - np.sqrt(energy)))


def test_a_full_record_scores_to_the_last_bit_as_before() -> None:
    full, _ = masked(4)
    y_hat = full.y + 0.1
    values = find_metric("rmse").values(full.y, y_hat)
    assert values.tobytes() == np.sqrt(np.mean((full.y - y_hat) ** 2, axis=0)).tobytes()


def test_distances_count_windows_with_the_whole_group() -> None:
    y = [np.array([[1.0, 2.0], [NAN, 0.0]]), np.array([[4.0, NAN], [3.0, 4.0]])]
    y_hat = [np.zeros((2, 2)), np.zeros((2, 2))]
    table = mee_table(y, y_hat, ["a", "b"], [OutputGroup("both", ("a", "b"), "")], ())
    assert table.groups[0].steps == pytest.approx((np.sqrt(5.0), 5.0))


def test_csv_with_gaps_reads_back(tmp_path: Path) -> None:
    _, lost = masked(5, outputs=1)
    path = tmp_path / "r.csv"
    path.write_text(record_csv(lost, ["u", "y"]))
    for text in (path.read_text(), path.read_text().replace("nan", "")):
        path.write_text(text)
        found = take_in([path], Wanted(("u",), ("y",)), "test", 1.0)
        assert data_digest(found.records) == data_digest([lost])
        assert "output values were not measured" in found.notes[0]


def test_intake_keeps_gaps_of_outputs_and_cuts_gaps_of_inputs(tmp_path: Path) -> None:
    rows = [f"{k / 10},{k % 7},{k % 5}" for k in range(120)]
    rows[0], rows[119], rows[20], rows[100] = "0.0,0,", "11.9,3,", "2.0,6,NaN", "10.0,,2"
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time,u,y", *rows]))
    for use in ("train", "test"):
        found = take_in([path], Wanted(("u",), ("y",)), use, None, 5)
        first, second = found.records
        assert (len(first), len(second)) == (99, 18)
        assert np.flatnonzero(~first.measured[:, 0]).tolist() == [19]
        assert "1 of 117 output values were not measured" in " ".join(found.notes)
    made = init_problem(tmp_path / "p", train=[path], test=[], inputs=["u"], outputs=["y"])
    problem = load_problem(made.path.parent)
    assert problem.train[0].missing is not None
    assert "not measured" in " ".join(problem.warnings)
