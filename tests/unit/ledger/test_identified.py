"""Identified parameters, as a ledger keeps it and people read it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.ledger.artifacts import Store
from asia.ledger.evidence import (
    EstimatedModel,
    EstimatedParameter,
    IdentifiedModel,
    IdentifiedParameter,
    get_estimates,
    put_estimates,
    with_fold_values,
)
from asia.presentation.parameters import identified_blocks, identified_object
from asia.presentation.table import block_lines

INF = float("inf")


def shown(found: IdentifiedModel) -> list[str]:
    return [*block_lines(identified_blocks(found))]


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
    lines = shown(found)
    assert lines[1].strip() == "d(x)/dt = -0.5 * x"
    assert "0.46 to 0.54" in next(line for line in lines if line.strip().startswith("k "))
    assert "not identifiable from these records: m" in lines
    assert "at the upper end of its range: m (10)" in lines
    assert "-0.970" in lines[-1]
    first = identified_object(found)["parameters"][0]
    assert first["interval_95"] == [0.46, 0.54]
    assert first["folds"] == [0.49, 0.51]
    assert first["at_bound"] is None


def test_equations_of_a_candidate_are_marked_as_its_own_words() -> None:
    rows = (IdentifiedParameter(fitted(), (), None),)
    own = IdentifiedModel(3, rows, ((1.0,),), ("y = x",))
    text = "\n".join(shown(own))
    assert "equations in the candidate's own words, not checked by ASIA:" in text
    assert "as the candidate's own code reports them:" in text
    assert identified_object(own)["reported_by"] == "candidate"
    library = replace(own, library=True)
    text = "\n".join(shown(library))
    assert "equations of the best candidate with the fitted numbers:" in text
    assert "candidate's own" not in text
    assert identified_object(library)["reported_by"] == "library"


def test_the_widest_source_decides_the_interval_to_quote() -> None:
    """value 0.5, by noise 0.46 to 0.54; its range is positive, so the scale is logarithmic."""
    near = IdentifiedParameter(fitted(), (0.49, 0.51), 0.01)
    assert (near.interval, near.decided_by, near.disagrees) == ((0.46, 0.54), "noise", False)
    apart = IdentifiedParameter(fitted(), (0.3, 0.7), 0.2)
    assert apart.interval == pytest.approx((0.5 / math.exp(0.784), 0.5 * math.exp(0.784)))
    assert (apart.decided_by, apart.disagrees) == ("folds", True)
    lacking = IdentifiedParameter(fitted(misfit_error=0.3, lower=-1.0), (0.49, 0.51), 0.01)
    assert lacking.interval == pytest.approx((0.2, 0.8))
    assert (lacking.decided_by, lacking.disagrees) == ("missing effect", False)
    unsettled = IdentifiedParameter(fitted(misfit_error=1.0), (0.49, 0.51), 0.01)
    lines = "\n".join(shown(IdentifiedModel(1, (unsettled,), ((1.0,),), ())))
    assert "no interval: its ends by the folds or a missing effect are a factor of 10" in lines
    assert "other values of these simulate" not in lines
    unknown = IdentifiedParameter(fitted(standard_error=None, low=None, high=None), (1.0, 2.0), 0.5)
    assert (unknown.interval, unknown.decided_by, unknown.disagrees) == (None, "noise", False)
    text = "\n".join(shown(IdentifiedModel(1, (apart, lacking), ((1.0,),), ())))
    assert "significantly different between the folds: k;" in text
    assert "an effect is missing, and the intervals include" in text


def test_the_jackknife_measures_the_fold_models_around_the_fitted_value() -> None:
    rows = with_fold_values(EstimatedModel((fitted(),), ((1.0,),), ()), [{"k": 0.4}, {"k": 0.8}])
    assert rows[0].fold_error == pytest.approx(math.sqrt(0.5 * (0.1**2 + 0.3**2)))
    assert (
        with_fold_values(EstimatedModel((fitted(),), ((1.0,),), ()), [{"k": 0.4}, {}])[0].folds
        == ()
    )


def test_values_without_standard_errors_are_printed_with_the_reason() -> None:
    bare = fitted(standard_error=None, low=None, high=None, data_share=1.0)
    model = IdentifiedModel(
        2, (IdentifiedParameter(bare, (), None),), ((None,),), ("dx = -0.5 * x",), True, "too short"
    )
    text = "\n".join(shown(model))
    assert "dx = -0.5 * x" in text
    assert "0.5" in text
    assert "no standard errors and intervals: too short" in text
    assert "not identifiable" not in text
    assert identified_object(model)["no_intervals"] == "too short"


def test_a_wide_interval_is_marked_and_the_bias_is_said_to_be_inside() -> None:
    wide = fitted(low=0.3, high=2.0, misfit_error=0.01)
    model = IdentifiedModel(2, (IdentifiedParameter(wide, (), None),), ((1.0,),), (), fit=61.0)
    text = "\n".join(shown(model))
    assert "interval wider than the value" in text
    assert "the bias that it may cause is smaller than the intervals" in text
    assert "the model fits 61 %, below 80 %" in text


def test_an_interval_of_orders_of_magnitude_and_one_at_a_bound_are_withheld() -> None:
    for one, reason in (
        (fitted(low=1.6e-25, high=6.9e23), "not identifiable from these records"),
        (fitted(value=9.999, low=5.0, high=10.0, upper=10.0), "at the upper end of its range"),
    ):
        found = IdentifiedParameter(one, (), None)
        assert found.interval is None
        text = "\n".join(shown(IdentifiedModel(2, (found,), ((1.0,),), ())))
        assert reason in text
        assert "95 % interval" not in text
