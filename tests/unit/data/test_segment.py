"""A part of a record."""

import numpy as np

from asia.data.segment import Segment

U, Y = np.arange(8.0)[:, None], np.array([[1.0], [np.nan], [3.0], [4.0]])
SEGMENT = Segment(U[:2], Y[:2], U[2:6], Y, "record", 3, 7)


def test_a_segment_without_its_outputs_keeps_their_shape_alone() -> None:
    sent = SEGMENT.unmeasured
    assert sent.y.shape == Y.shape
    assert np.isnan(sent.y).all()
    assert (sent.name, sent.record, sent.start, sent.stop) == ("record", 3, 7, 11)


def test_a_simulated_segment_can_be_simulated_again() -> None:
    once = SEGMENT.simulated(Y)
    again = once.simulated(np.array([[0.0], [7.0], [0.0], [0.0]]))
    # The error lies on a straight line between the measured samples.
    assert again.residual[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert again.complete_y[:, 0].tolist() == [1.0, 9.0, 3.0, 4.0]
    assert len(again.part(0, 2).y) == len(again.part(0, 2).y_hat) == 2
    later = again.part(1, 3)
    assert np.array_equal(later.past_u, U[1:3])
    np.testing.assert_array_equal(later.past_y, np.concatenate([Y[1:2], again.y[:1]]))
    assert later.start == again.start + 1
