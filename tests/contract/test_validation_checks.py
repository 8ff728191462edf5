"""Every validation check passes its suite, and the suite fails for those that break a rule."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from asia.analysis.validation import VALIDATION_CHECKS, validation_checks
from asia.errors import UserError
from asia.judge.scoring.checks.check import Cause, Check, CheckCurve, Verdict
from asia.judge.scoring.checks.validation_data import ValidationData
from asia.testing import check_validation_check
from tests.unit.made_up_parts import installed

PLUGGED = """
from asia.judge.scoring.checks.check import Check, Verdict

def largest(data):
    worst = max(abs(b.residual).max() for b in data.simulations.blocks)
    return Check("largest error", Verdict.SHOWN, f"largest error {worst:.3g}")

nothing = 3
"""


@pytest.mark.parametrize("name", VALIDATION_CHECKS)
def test_every_built_in_check(name: str) -> None:
    check_validation_check(VALIDATION_CHECKS[name])


def mean_error(data: ValidationData) -> Check:
    mean = float(np.mean([b.residual.mean() for b in data.simulations.blocks]))
    return Check("mean error", Verdict.SHOWN, f"mean error {mean:.3g}")


def constant(data: ValidationData) -> Check:
    return Check("constant", Verdict.PASS, "all is well")


def changing(data: ValidationData) -> Check:
    found = mean_error(data)
    data.simulations.blocks[0].u[:] = 0.0
    return found


def intolerant(data: ValidationData) -> Check:
    y = np.concatenate([b.y for b in data.simulations.blocks])
    assert not np.isnan(y).any(), "gaps"
    return mean_error(data)


NUMBERS = count()


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (constant, "none of the defects .* changes the result"),
        (changing, "the arrays were changed"),
        (intolerant, "gaps"),
        (lambda d: "fine", "the result is 'fine', expected a Check"),
        (lambda d: replace(mean_error(d), verdict=Verdict.FAIL), "a sound model fails"),
        (lambda d: replace(mean_error(d), sentence=f"{next(NUMBERS)}"), "give another result"),
        (
            lambda d: replace(mean_error(d), sentence="two\nlines"),
            "expected a sentence of one line",
        ),
        (lambda d: (mean_error(d), mean_error(d)), "a name is used twice"),
        (lambda d: replace(mean_error(d), cause=Cause.DRIFT), "a cause or a weight with verdict"),
        (
            lambda d: replace(mean_error(d), curves=(CheckCurve("c", np.ones(2), np.ones(3)),)),
            "expected two of",
        ),
    ],
)
def test_the_suite_finds(broken: Callable[[ValidationData], Check], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_validation_check(broken)


def test_a_check_of_another_package(tmp_path: Path) -> None:
    points = "[asia.validation_checks]\nlargest_error = errors_of_mine:largest\n"
    with installed(tmp_path, "errors_of_mine", PLUGGED, points):
        assert tuple(validation_checks()) == (*VALIDATION_CHECKS, "largest_error")
        check_validation_check(validation_checks()["largest_error"])


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ("residuals = errors_of_mine:largest", "ASIA has a check of this name"),
        ("mine = errors_of_mine:nothing", "is 3, expected a function"),
    ],
)
def test_a_part_that_is_no_check(point: str, message: str, tmp_path: Path) -> None:
    points = f"[asia.validation_checks]\n{point}\n"
    with (
        installed(tmp_path, "errors_of_mine", PLUGGED, points),
        pytest.raises(UserError, match=message),
    ):
        validation_checks()
