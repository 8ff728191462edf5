"""Named parameters and prints: taken before a case is seen, bounded, and never a reason to fail."""

from types import SimpleNamespace

import numpy as np
import pytest

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.errors import CandidateError, SandboxError
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.figures import (
    PARAMETERS,
    count_numbers,
    pack_estimates,
    pack_parameters,
    unpack_estimates,
    unpack_parameters,
)


@pytest.fixture
def level() -> Isolation:
    """The strongest one: none of this depends on the layers."""
    return probe().level


SOURCE = """
import numpy as np


class Model:
    def __init__(self, offered):
        self.offered = offered

    def parameters(self):
        print("asked")
        return self.offered()

    def simulate(self, past_u, past_y, u):
        print("case", past_y)
        return np.zeros((*u.shape[:2], 2))


def offered():
    OFFERED


def fit(trajectories, context):
    print("fitting")
    return Model(offered)
"""


def source(body: str) -> str:
    return SOURCE.replace("OFFERED", body)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("return {'k1': 0.5, 'tank limit': np.float32(2)}", (("k1", 0.5), ("tank limit", 2.0))),
        ("return {'a': float('nan'), 'b': float('inf'), 'c': 1}", (("c", 1.0),)),
        ("return {'\\x1b[31m<b>': 1.0}", (("_[31m_b_", 1.0),)),
        ("return [1.0, 2.0]", ()),
        ("return {'a': 'many'}", ()),
        ("raise RuntimeError('not now')", ()),
    ],
)
def test_parameters_are_names_and_finite_numbers_or_nothing(worker, case, body, expected):
    with worker() as one:
        one.fit(source(body), case.trajectories, case.context)
        assert one.parameters() == expected
        assert one.simulate(case.past_u, case.past_y, case.u).shape == (3, 40, 2)
        assert "fitting" in one.printed
        assert "asked" not in one.printed
        assert "case" not in one.printed


def test_parameters_are_not_asked_for_once_a_case_was_seen(worker, case):
    with worker() as one:
        one.fit(source("return {'a': 1.0}"), case.trajectories, case.context)
        one.simulate(case.past_u, case.past_y, case.u)
        with pytest.raises(SandboxError, match="before"):
            one.parameters()


def test_a_failed_fit_keeps_its_output(worker, case):
    failing = source("return {}").replace("return Model(offered)", "raise ValueError('stop')")
    with worker() as one:
        with pytest.raises(CandidateError):
            one.fit(failing, case.trajectories, case.context)
        assert one.printed == "fitting\n"


def test_the_memory_of_a_worker_is_measured(worker, case):
    large = source("return {}").replace("print('fitting')", "")
    with worker() as one:
        one.fit(large, case.trajectories, case.context)
        peak = one.peak_memory_mb
    assert peak is None or 20 < peak < 4096


def test_rows_are_bounded_in_number_and_checked():
    many = {f"p{i}": float(i) for i in range(3 * PARAMETERS)}
    assert len(unpack_parameters(pack_parameters(many))) == PARAMETERS
    row = pack_parameters({"a": 1.0})
    for wrong in (row[:-1], row * (PARAMETERS + 1), row[:-8] + np.float64("nan").tobytes()):
        with pytest.raises(ValueError, match="parameter"):
            unpack_parameters(wrong)


ESTIMATING = """
import numpy as np
from asia.candidate import ParameterEstimate, ParameterEstimates


class Model:
    def estimates(self, trajectories, context):
        samples = float(sum(len(t) for t in trajectories))
        OFFERED

    def simulate(self, past_u, past_y, u):
        return np.zeros((*u.shape[:2], 2))


def fit(trajectories, context):
    return Model()
"""


def test_estimates_use_the_fitted_records(worker, case):
    body = """
        rows = (ParameterEstimate("k", samples, 0.5, 1.0, 2.0, "V/s", 0.1),)
        return ParameterEstimates(rows, np.eye(1), ("x = 1", "\\x1b[31mred"))"""
    with worker() as one:
        one.fit(ESTIMATING.replace("OFFERED", body), case.trajectories, case.context)
        found = one.estimates()
        assert one.simulate(case.past_u, case.past_y, case.u).shape == (3, 40, 2)
    samples = float(sum(len(t) for t in case.trajectories))
    assert found.parameters == (ParameterEstimate("k", samples, 0.5, 1.0, 2.0, "V/s", 0.1),)
    assert found.equations == ("x = 1", "_[31mred")
    assert found.correlation.tolist() == [[1.0]]


@pytest.mark.parametrize("body", ["return 1.0", "raise ValueError", "return None"])
def test_estimates_that_fail_are_none_and_no_failure(worker, case, body):
    with worker() as one:
        one.fit(ESTIMATING.replace("OFFERED", body), case.trajectories, case.context)
        assert one.estimates() is None


def test_values_come_with_the_reason_where_standard_errors_fail(worker, case):
    naming = ESTIMATING.replace("OFFERED", "raise ValueError('too short\\x1b[31m')").replace(
        "    def simulate",
        "    def parameters(self):\n        return {'k': 2.0, 'bad': float('nan')}\n\n"
        "    def equations(self):\n        return ['d(x)/dt = -2 * x']\n\n    def simulate",
    )
    with worker() as one:
        one.fit(naming, case.trajectories, case.context)
        found = one.estimates()
    assert [(p.name, p.value) for p in found.parameters] == [("k", 2.0)]
    assert np.isnan(found.parameters[0].standard_error)
    assert found.equations == ("d(x)/dt = -2 * x",)
    assert found.reason == "too short_[31m"


def test_estimates_are_not_asked_for_once_a_case_was_seen(worker, case):
    with worker() as one:
        one.fit(ESTIMATING.replace("OFFERED", "return None"), case.trajectories, case.context)
        one.simulate(case.past_u, case.past_y, case.u)
        with pytest.raises(SandboxError, match="before"):
            one.estimates()


def estimates(count: int, equations: tuple[str, ...] = ()) -> ParameterEstimates:
    rows = tuple(ParameterEstimate(f"p{i}", 1.0, 2.0, 0.0, 3.0) for i in range(count))
    return ParameterEstimates(rows, np.eye(count), equations)


def test_estimates_come_back_as_they_were_packed():
    body = pack_estimates(estimates(70, ("a = b",) * 2000))
    found = unpack_estimates(body)
    assert len(found.parameters) == PARAMETERS
    assert np.array_equal(found.correlation, np.eye(PARAMETERS))
    assert len("\n".join(found.equations)) <= 8000


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\xff" * 8,
        pack_estimates(estimates(2))[:-1],
        pack_estimates(estimates(1)) + b"x" * 9000,
        pack_estimates(estimates(2)).replace(b"p1", b"p0"),
        pack_estimates(estimates(1)).replace(np.float64(1.0).tobytes(), b"\xff" * 8, 1),
    ],
)
def test_an_invalid_table_of_estimates_is_refused(body):
    with pytest.raises(ValueError, match=r"estimates|parameter"):
        unpack_estimates(body)


FORGED = """
import gc


class Model:
    def simulate(self, past_u, past_y, u):
        return u[..., :1].repeat(2, axis=2)


def fit(trajectories, context):
    for one in gc.get_objects():
        if type(one).__name__ == "Meter":
            one._spent["fit"] = [VALUE, 0.0]
    return Model()
"""


def test_numbers_of_a_model_are_counted_once_each_and_settings_are_none():
    weights = np.zeros((3, 4))
    shared = SimpleNamespace(weights=weights, again=weights, order=3, name="x", kept=True, f=len)
    model = SimpleNamespace(parts=[shared, shared], gain=0.5, lags=np.arange(5), m={"a": 1.5})
    assert count_numbers(model, {}) == 12 + 1 + 1
    assert count_numbers(SimpleNamespace(inner=SimpleNamespace(n_parameters=6, z=0.1)), {}) == 6


@pytest.mark.parametrize(
    ("offered", "expected"),
    [("0.5", 1), ("[0.5, 1.5]", 2), ("type('M', (), {'n_parameters': -1})()", None)],
)
def test_a_model_without_a_count_has_none(worker, case, offered, expected):
    with worker() as one:
        one.fit(
            source("pass").replace("Model(offered)", f"Model({offered})"),
            case.trajectories,
            case.context,
        )
        assert one.numbers() == expected
        one.simulate(case.past_u, case.past_y, case.u)
        with pytest.raises(SandboxError, match="before them"):
            one.numbers()


@pytest.mark.parametrize("value", ["1e9", "float('nan')", "-1.0"])
def test_compile_seconds_are_bounded_by_the_fit(worker, case, value):
    with worker() as one:
        one.fit(FORGED.replace("VALUE", value), case.trajectories, case.context)
        assert 0.0 <= one.compile_seconds() <= sum(wall for wall, _ in one.spent.values())


def test_compile_seconds_are_not_asked_for_once_a_case_was_seen(worker, case):
    with worker() as one:
        one.fit(FORGED.replace("VALUE", "1.0"), case.trajectories, case.context)
        one.simulate(case.past_u, case.past_y, case.u)
        with pytest.raises(SandboxError, match="before them"):
            one.compile_seconds()
