from __future__ import annotations

import pytest

from asia._text import nearest


@pytest.mark.parametrize(
    ("word", "known", "expected"),
    [
        ("fodls", ["folds", "kind"], "; did you mean 'folds'?"),
        ("Pump_Voltage", ["pump_voltage"], "; did you mean 'pump_voltage'?"),
        ("zzz", ["folds", "kind"], "; known: folds, kind"),
        ("zzz", [], ""),
    ],
)
def test_suggestion(word: str, known: list[str], expected: str) -> None:
    assert nearest(word, known) == expected
