from __future__ import annotations

import numpy as np
import pytest

from asia.report._drawing.tags import Surroundings, Tag, crosses, place

FRAME = (0.0, 0.0, 800.0, 400.0)
NO_LINES = np.empty((0, 4))


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((np.maximum(a[:2], b[:2]) < np.minimum(a[2:], b[2:])).all())


@pytest.mark.parametrize("seed", range(5))
def test_tags_keep_clear_of_each_other_of_points_and_of_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform((20.0, 20.0), (780.0, 380.0), (25, 2))
    tags = [Tag((float(x), float(y)), (110.0, 24.0)) for x, y in points[:10]]
    found = place(tags, Surroundings(FRAME, points, 6.0, NO_LINES, 200.0))
    boxes = [
        np.array([*p.corner, p.corner[0] + t.size[0], p.corner[1] + t.size[1]])
        for p, t in zip(found, tags, strict=True)
        if p is not None
    ]
    assert len(boxes) >= 8
    leaders = [(t.anchor, p.leader) for p, t in zip(found, tags, strict=True) if p is not None]
    assert all(np.hypot(a[0] - b[0], a[1] - b[1]) < 200.0 for a, b in leaders)
    for i, box in enumerate(boxes):
        assert (box[:2] >= 0.0).all()
        assert (box[2:] <= FRAME[2:]).all()
        assert not any(overlap(box, other) for other in boxes[:i])
        inside = (points > box[:2] - 5.0) & (points < box[2:] + 5.0)
        assert not inside.all(axis=1).any()


def test_a_tag_without_room_has_no_place() -> None:
    tags = [Tag((5.0, 5.0), (90.0, 30.0)), Tag((50.0, 5.0), (90.0, 30.0))]
    around = Surroundings(
        (0.0, 0.0, 100.0, 60.0), np.array([[5.0, 5.0], [50.0, 5.0]]), 2.0, NO_LINES, 200.0
    )
    first, second = place(tags, around)
    assert first is not None
    assert second is None


def test_a_tag_lies_beside_its_point_and_off_a_line() -> None:
    line = np.array([[0.0, 200.0, 800.0, 200.0]])
    around = Surroundings(FRAME, np.array([[400.0, 200.0]]), 6.0, line, 200.0)
    (found,) = place([Tag((400.0, 200.0), (100.0, 20.0))], around)
    assert found is not None
    assert np.hypot(found.leader[0] - 400.0, found.leader[1] - 200.0) < 20.0
    assert not found.corner[1] < 200.0 < found.corner[1] + 20.0


@pytest.mark.parametrize(
    ("segment", "through"),
    [
        ((0.0, 0.0, 10.0, 10.0), True),
        ((5.0, -9.0, 5.0, 9.0), True),
        ((0.0, 9.0, 9.0, 9.0), False),
        ((0.0, 0.0, 3.9, 3.9), False),
        ((5.0, 5.0, 5.5, 5.5), True),
        ((7.0, 0.0, 7.0, 9.0), False),
    ],
)
def test_crosses(segment: tuple[float, ...], through: bool) -> None:
    box = np.array([[4.0, 4.0, 6.0, 6.0]])
    assert bool(crosses(box, np.array([segment]))[0, 0]) is through
