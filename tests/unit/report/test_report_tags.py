from __future__ import annotations

import numpy as np
import pytest

from asia.report.drawing.places import Box, Tag, place

FRAME = Box(0.0, 0.0, 800.0, 400.0)


@pytest.mark.parametrize("seed", range(2))
def test_tags_keep_clear_of_each_other_of_points_and_of_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = [(float(x), float(y)) for x, y in rng.uniform((20.0, 20.0), (780.0, 380.0), (25, 2))]
    tags = [Tag(point, (110.0, 24.0)) for point in points[:10]]
    boxes = [box for box in place(tags, points, FRAME) if box is not None]
    assert len(boxes) >= 8
    for i, box in enumerate(boxes):
        assert FRAME.holds(box)
        assert not any(box.meets(other) for other in boxes[:i])
        assert not any(
            box.left - 5 < x < box.right + 5 and box.top - 5 < y < box.bottom + 5 for x, y in points
        )


def test_a_tag_without_room_has_no_place() -> None:
    tags = [Tag((5.0, 50.0), (90.0, 30.0)), Tag((50.0, 50.0), (90.0, 30.0))]
    first, second = place(tags, [tag.anchor for tag in tags], Box(0.0, 0.0, 100.0, 60.0))
    assert first is not None
    assert second is None
