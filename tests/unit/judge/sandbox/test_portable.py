"""Fitted models name no place of the machine they were fitted on."""

import os
import pickle
import sys

import numpy as np
import pytest

import asia
from asia.errors import CandidateError
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.portable import PlaceError, places_here, portable


@pytest.fixture
def level() -> Isolation:
    """The strongest one: none of this depends on the layers."""
    return probe().level


# A closure of the standard library, pickled with its code; the place of a library; the home.
HOLDS = """
import contextlib
import os

import asia


class Model:
    def __init__(self):
        @contextlib.contextmanager
        def halved():
            yield 0.5

        self.halved = halved
        self.said = f"fitted in {os.environ['HOME']}/fold with {asia.__file__}"
        self.extra = EXTRA

    def simulate(self, past_u, past_y, u):
        with self.halved() as factor:
            return factor * (u @ [[1.0, 0.0], [0.0, 1.0]][: u.shape[2]]) + past_y[:, -1:]


def fit(trajectories, context):
    return Model()
"""


def test_a_stored_model_names_no_folder_and_simulates_the_same(worker, case):
    source = HOLDS.replace("EXTRA", "None")
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        first = one.simulate(case.past_u, case.past_y, case.u)
        model = one.dump()
    here = os.path.dirname(os.path.dirname(asia.__file__))
    for place in (here, sys.prefix, os.path.dirname(os.__file__), "/tmp/asia-worker"):
        assert place.encode() not in model
    assert b"asia/__init__.py" in model
    assert b"contextlib.py" in model
    with worker() as two:
        two.load(source, model, case.context)
        assert np.array_equal(first, two.simulate(case.past_u, case.past_y, case.u))


def test_bytes_with_a_folder_are_refused(worker, case):
    source = HOLDS.replace("EXTRA", "asia.__file__.encode()")
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        with pytest.raises(CandidateError, match="could not be published"):
            one.dump()


def test_only_strings_change_and_all_else_comes_back():
    places = ("/home/me/", "/home/me/.venv/lib/")
    held = {
        "file": "/home/me/.venv/lib/scipy/odr.py",
        "twice": "/home/me/a then /home/me/b",
        "other": "at/home/me/a",
        "array": np.arange(5000.0),
        "long": 70_000 * "x" + " /home/me/z",
    }
    back = pickle.loads(portable(pickle.dumps(held, protocol=5), places))
    assert back["file"] == "scipy/odr.py"
    assert back["twice"] == "a then b"
    assert back["other"] == held["other"]
    assert np.array_equal(back["array"], held["array"])
    assert back["long"] == 70_000 * "x" + " z"


def test_a_pickle_without_places_is_unchanged():
    data = pickle.dumps({"a": np.arange(3.0), "b": "/usr/lib"}, protocol=5)
    assert portable(data, ("/home/me/",)) is data


def test_bytes_may_not_change():
    with pytest.raises(PlaceError):
        portable(pickle.dumps(b"x /home/me/b", protocol=5), ("/home/me/",))


def test_general_places_are_none_of_this_machine():
    places = places_here(["/opt/somewhere/asia"])
    assert "/opt/somewhere/" in places
    assert "/usr/" not in places
    assert all(place.startswith("/") and place.endswith("/") for place in places)
