"""What was identified, as a ledger keeps it and people read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.ledger import (
    EstimatedParameter,
    IdentifiedModel,
    IdentifiedParameter,
    Store,
    get_estimates,
    identified_lines,
    identified_object,
    put_estimates,
)

INF = float("inf")


def fitted(**changes: object) -> EstimatedParameter:
    settings: dict[str, object] = {
        "name": "k", "unit": "1/s", "value": 0.5, "standard_error": 0.02, "low": 0.46,
        "high": 0.54, "lower": 0.1, "upper": 10.0, "data_share": 1.0,
    }  # fmt: skip
    return EstimatedParameter(**(settings | changes))  # pyright: ignore[reportArgumentType]


def test_estimates_are_kept_with_what_is_infinite_left_open(tmp_path: Path) -> None:
    (tmp_path / "artifacts").mkdir()
    store = Store(tmp_path / "artifacts")
    rows = (
        ParameterEstimate("a", 1.0, 0.1, 0.8, 1.2, "V", 0.0, INF),
        ParameterEstimate("b", 2.0, INF, -INF, INF, data_share=0.0),
    )
    correlation = np.array([[1.0, np.nan], [np.nan, np.nan]])
    name = put_estimates(store, ParameterEstimates(rows, correlation, ("y = x",)))
    found = get_estimates(store, name)
    a, b = found.parameters
    assert a == EstimatedParameter("a", "V", 1.0, 0.1, 0.8, 1.2, 0.0, None, 1.0)
    assert (b.standard_error, b.low, b.high) == (None, None, None)
    assert found.correlation == ((1.0, None), (None, None))
    assert found.equations == ("y = x",)
    assert a.identifiable
    assert not b.identifiable


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"standard_error": None}, False),
        ({"data_share": 0.4}, False),
        ({"low": 0.01, "high": 20.0}, False),
        ({"low": 0.01, "high": 5.0}, True),
        ({"low": -9.0, "high": 99.0, "upper": None}, True),
    ],
)
def test_it_is_identifiable_where_the_records_know_it_better_than_its_range(
    changes: dict[str, object], expected: bool
) -> None:
    assert fitted(**changes).identifiable is expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ""),
        ({"value": 0.1001}, "lower"),
        ({"value": 9.9}, "upper"),
        ({"value": 11.0}, "upper"),
        ({"value": 0.11}, ""),  # the range is searched on a logarithmic scale
        ({"value": -0.995, "lower": -1.0, "upper": 1.0}, "lower"),
        ({"value": 10.0, "upper": None}, ""),
    ],
)
def test_it_sits_at_a_bound_at_the_end_of_its_range(
    changes: dict[str, object], expected: str
) -> None:
    assert fitted(**changes).at_bound == expected


def test_people_and_scripts_read_the_same() -> None:
    rows = (
        IdentifiedParameter(fitted(), (0.49, 0.51), 0.01),
        IdentifiedParameter(fitted(name="m", value=10.0, standard_error=None, low=None), (), None),
    )
    found = IdentifiedModel(3, rows, ((1.0, -0.97), (-0.97, 1.0)), ("d(x)/dt = -0.5 * x",))
    lines = list(identified_lines(found))
    assert lines[1].strip() == "d(x)/dt = -0.5 * x"
    assert "0.46 to 0.54" in next(line for line in lines if line.strip().startswith("k "))
    other = next(line for line in lines if line.strip().startswith("m "))
    assert "not identifiable" in other
    assert "upper end of its range, 10" in other
    assert "-0.970" in lines[-1]
    first = identified_object(found)["parameters"][0]
    assert first["interval_95"] == [0.46, 0.54]
    assert first["folds"] == [0.49, 0.51]
    assert first["at_bound"] is None
