"""Every model family: fit, bytes, fresh worker, bitwise the same simulation; a second fit too."""

import pkgutil
from dataclasses import replace

import pytest

import asia.models
from asia.agents.library.registry import all_families
from asia.recipe import MODELS
from asia.testing import check_family


def test_every_family_has_one_row():
    modules = {module.name for module in pkgutil.iter_modules(asia.models.__path__)}
    public = {name for name in modules if not name.startswith("_")} - {
        "controllers",
        "frequency_response",
        "methods",
        "static_maps",
        "uncertainty",
    }
    assert sorted(row.name for row in all_families() if row.package == MODELS) == sorted(public)


# One that compiles and two that do not; their fits are the quickest.
QUICK = {"linear", "narx", "arx"}


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=row.name, marks=() if row.name in QUICK else pytest.mark.long)
        for row in all_families()
    ],
)
def test_a_family_conforms(row):
    """A few at every change, all of them before a release."""
    check_family(row)


def test_the_suite_refuses_a_setting_that_the_family_has_not():
    row = next(row for row in all_families() if row.name == "arx")
    with pytest.raises(KeyError, match="units"):
        check_family(replace(row, small=(("units", 4),)))
    wrong = replace(row, start=lambda facts: row.trial(facts).configured(units=4))
    with pytest.raises(TypeError, match="units"):
        check_family(wrong)
