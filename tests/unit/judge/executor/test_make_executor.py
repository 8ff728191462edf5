import sys
from threading import Event
from types import ModuleType

import pytest

import asia.judge.executors as executors
from asia import _progress, candidate
from asia._plugins import Part
from asia._progress import reported, tracked
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


def test_loops_of_a_single_job_are_the_progress_of_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_progress, "SILENCE", 0.01)
    lines, counted = list[str](), Event()

    def say(line: str) -> None:
        lines.append(line)
        if "item 1 of 1" in line or "job 1 of 2" in line:
            counted.set()

    def job() -> bool:
        return all(counted.wait(30) for _ in tracked([1], "item"))

    with reported("next", say):
        assert LocalExecutor(1).run([job]) == [True]
        counted.clear()
        assert LocalExecutor(2).run([job, job]) == [True, True]
    assert not any("job" in line and "item" in line for line in lines)
