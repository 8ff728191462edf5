"""Packages that bring parts are read by workers at every level, and nothing beside them."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from asia import _plugins
from asia.errors import CandidateError, UserError
from asia.judge.sandbox.layers.environment import shown_in
from asia.judge.sandbox.levels import LEVELS
from asia.search.run import check_hidden_from_workers

from .conftest import one_level

ENTRY_POINTS = "[asia.families]\ngain = odd_gain.model:Gain\noffset = odd_offset:Offset\n"
MODEL = """
from odd_gain.inner import TWO


class Gain:
    def simulate(self, past_u, past_y, u):
        return TWO * u.sum(axis=2, keepdims=True) + 0 * past_y[:, -1:, :]
"""
SOURCE = """
import odd_offset
from odd_gain.model import Gain


def fit(trajectories, context):
    print(odd_offset.OFFSET)
    return Gain()
"""
BESIDE = """
def fit(trajectories, context):
    for name in ("odd_neighbour", "odd_gain_tests"):
        try:
            __import__(name)
            print("imported", name)
        except ImportError:
            pass
    for place in PLACES:
        try:
            print("read", open(place).read())
        except OSError:
            pass
    from odd_gain.model import Gain
    return Gain()
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An editable install: a project on the import path, with other things beside the package."""
    project = tmp_path / "project"
    for name, text in {
        "odd-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n",
        "odd-1.0.dist-info/entry_points.txt": ENTRY_POINTS,
        "odd_gain/__init__.py": "",
        "odd_gain/model.py": MODEL,
        "odd_gain/inner/__init__.py": "TWO = 2.0\n",
        "odd_offset.py": "OFFSET = 'offset'\n",
        "odd_neighbour.py": "",
        "odd_gain_tests/__init__.py": "",
        "data/test.csv": "u,y\n0,1\n",
        "runs/ledger.jsonl": "{}\n",
    }.items():
        path = project / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(project))
    _plugins._all_parts.cache_clear()
    yield project
    _plugins._all_parts.cache_clear()
    for name in [name for name in sys.modules if name.startswith("odd_")]:
        del sys.modules[name]


def test_candidates_import_packages_of_parts(project, worker, case):
    with worker() as one:
        reply = one.fit(SOURCE, case.trajectories, case.context)
        y = one.simulate(case.past_u, case.past_y, case.u)
    assert reply[1] == "offset\n"
    assert (y == 2.0 * case.u).all()


def test_neighbouring_files_are_invisible(project, level, worker, case):
    if not LEVELS[level].confined:
        pytest.skip("this level hides nothing")
    places = [project / "data" / "test.csv", project / "runs" / "ledger.jsonl"]
    places += [project / "odd_neighbour.py", project / "odd-1.0.dist-info" / "METADATA"]
    source = BESIDE.replace("PLACES", repr([str(place) for place in places]))
    with worker() as one:
        assert one.fit(source, case.trajectories, case.context)[1] == ""


def test_a_worker_cannot_change_them(project, level, worker, case):
    if not LEVELS[level].confined:
        pytest.skip("this level hides nothing")
    source = f"def fit(trajectories, context):\n    open({str(project / 'odd_offset.py')!r}, 'a')\n"
    with worker() as one, pytest.raises(CandidateError, match=r"OSError|PermissionError"):
        one.fit(source, case.trajectories, case.context)


def test_runs_and_data_may_be_next_to_packages_but_not_inside(project):
    assert shown_in(project / "runs") is None
    check_hidden_from_workers(project / "data" / "test.csv")
    assert shown_in(project / "odd_gain" / "runs") == str(project / "odd_gain")
    with pytest.raises(UserError, match="package of a part"):
        check_hidden_from_workers(project / "odd_gain" / "runs")


@one_level
def test_a_package_without_init_is_found(project, worker, case):
    (project / "odd_gain" / "__init__.py").unlink()
    with worker() as one:
        one.fit(SOURCE, case.trajectories, case.context)


@one_level
def test_a_package_that_is_not_there_hides_no_other(project, worker, case):
    (project / "odd_offset.py").unlink()
    assert [package.name for package in _plugins.plugin_packages()] == ["odd_gain"]
    with worker() as one:
        one.fit(
            SOURCE.replace("import odd_offset", "odd_offset = 0").replace(
                "print(odd_offset.OFFSET)", "pass"
            ),
            case.trajectories,
            case.context,
        )
