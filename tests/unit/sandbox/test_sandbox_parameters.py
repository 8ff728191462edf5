"""Named parameters and prints: taken before a case is seen, bounded, and never a reason to fail."""

import numpy as np
import pytest

from asia.errors import CandidateError, SandboxError
from asia.sandbox.worker.wire import PARAMETERS, pack_parameters, unpack_parameters

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


def test_a_failed_fit_leaves_what_it_printed(worker, case):
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
