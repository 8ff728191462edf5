"""A table says when the agents were shown residuals of what V is computed on."""

import pytest

from asia.assurance.bench.comparison import Comparison, comparison_table
from asia.problem.protocol import ShownResidual


@pytest.mark.parametrize(("shown", "said"), [("train", False), ("held_out", True)])
def test_shown_held_out_residuals_are_in_the_title(shown: ShownResidual, said: bool) -> None:
    table = comparison_table(Comparison("inner", (), (), shown), None)
    assert ("agents saw residuals of the held-out folds" in table.title) is said
