import sys
from types import ModuleType

import pytest

import asia.judge.executors as executors
from asia import candidate
from asia._plugins import Part
from asia.candidate import installed_libraries
from asia.errors import UserError
from asia.judge.executors import LocalExecutor, make_executor


@pytest.fixture
def bring(monkeypatch):
    """Another package brings this as its executor `far`."""

    def plug(thing: object) -> None:
        module = ModuleType("far_away")
        module.Far = thing
        monkeypatch.setitem(sys.modules, "far_away", module)
        part = Part("asia.executors", "far", "far_away:Far", "far", "1.0")
        monkeypatch.setattr(executors, "parts_of", lambda group: (part,))

    return plug


def test_the_built_in_one_has_a_name():
    assert isinstance(make_executor("local"), LocalExecutor)


def test_an_installed_package_brings_one(bring):
    class Far(LocalExecutor):
        pass

    bring(Far)
    assert isinstance(make_executor("far"), Far)
    assert executors.executor_names() == ("local", "dask", "dask-slurm", "far")


@pytest.mark.parametrize("thing", [3, dict])
def test_a_part_that_is_no_executor_is_named(bring, thing):
    bring(thing)
    with pytest.raises(UserError, match=r"far_away:Far of package far 1\.0"):
        make_executor("far")


def test_an_unknown_name_gets_the_nearest(bring):
    bring(LocalExecutor)
    with pytest.raises(UserError, match="did you mean 'local'"):
        make_executor("locl")


def test_only_libraries_that_are_installed_are_named(monkeypatch):
    found = candidate.is_installed
    monkeypatch.setattr(candidate, "is_installed", lambda n: n != "equinox" and found(n))
    assert installed_libraries() == ("numpy", "scipy", "jax", "optax")
