"""Every source passes the suite, and the suite refuses what does not conform."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest

from asia._plugins import Part
from asia.data import Signal, Trajectory
from asia.data.sources import SOURCES, Channels, DataSet, SourceData, Subset, source_class
from asia.data.sources.files import RecordFiles
from asia.data.sources.nanodrone import Nanodrone
from asia.data.sources.official import OfficialBenchmark
from asia.data.sources.simulated.source import Simulated
from asia.errors import UserError
from asia.problem.create import init_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.testing import check_source

ONE = Channels((Signal("u"),), (Signal("y"),), 0.5)


def write(path: Path, seed: int, columns: str = "u,y", samples: int = 90) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.random.default_rng(seed).standard_normal((samples, columns.count(",") + 1))
    np.savetxt(path, rows, delimiter=",", header=columns, comments="")
    return path


@dataclass(frozen=True)
class Loggers(DataSet):
    """A made-up source of another package: one NumPy file a record in the folder it names."""

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        found = [np.load(path) for path in self._files(subset)]
        return SourceData(
            tuple(
                Trajectory(values[:, :1], values[:, 1:], channels.sampling_time, f"log{k}")
                for k, values in enumerate(found, 1)
            )
        )

    def places(self, subset: Subset) -> tuple[Path, ...]:
        return self._files("test" if subset == "test" else "train")

    def _files(self, subset: str) -> tuple[Path, ...]:
        return tuple(sorted(Path(self.argument).glob(f"{subset}*.npy")))


def logs(folder: Path) -> str:
    """A folder of records of `Loggers`, as data.source names it."""
    for k, name in enumerate(("train1", "train2", "test1")):
        np.save(folder / f"{name}.npy", np.random.default_rng(k).standard_normal((90, 2)))
    return f"loggers:{folder}"


def test_record_files_conform(tmp_path: Path) -> None:
    a, b, c, d = (write(tmp_path / f"{name}.csv", k) for k, name in enumerate("abcd"))
    check_source(lambda: RecordFiles((a, b), (c,), (d,)), ONE)
    check_source(lambda: RecordFiles((a,)), ONE)


def test_a_sealed_store_conforms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASIA_KEYS", str(tmp_path / "keys"))
    a, b = (write(tmp_path / f"{name}.csv", k) for k, name in enumerate("ab"))
    made = init_problem(
        tmp_path / "mine",
        train=[a],
        test=[b],
        inputs=["u"],
        outputs=["y"],
        sampling_time=0.5,
        seal=True,
    )
    source = load_problem(made.path).test.source
    assert source is not None
    assert made.store is not None
    check_source(lambda: source, ONE, harmless=[made.store])


@pytest.mark.parametrize("guard", [0, 2])
def test_simulated_tanks_conform(guard: int) -> None:
    check_source(lambda: Simulated(3, guard), Channels((Signal("u"),), (Signal("y"),), 4.0))


def test_nanodrone_conforms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path))
    columns = "t,u,y"
    for part, kinds, count in (
        ("train", ("chirp", "random", "square"), 4),
        ("test", ("melon",), 3),
    ):
        for number, kind in enumerate(kinds):
            for run in range(1, count + 1):
                name = f"nanodrone/data/{part}/{kind}_20251017_run{run}.csv"
                write(tmp_path / name, 10 * number + run + 100 * (part == "test"), columns)
    for guard in ((), ("chirp_20251017_run2", "square_20251017_run1")):
        check_source(lambda guard=guard: Nanodrone(guard=guard), ONE)


def test_every_source_of_the_table_is_tested_here() -> None:
    assert set(SOURCES.values()) == {
        Nanodrone,
        OfficialBenchmark,
        Simulated,
    }


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Brings a class of this module as source `loggers` of an installed package."""

    def plug(name: str) -> None:
        part = Part("asia.sources", "loggers", f"{__name__}:{name}", "made-up", "1.0")
        monkeypatch.setattr("asia.data.sources.parts_of", lambda group: (part,))

    return plug


def test_a_source_of_another_package_conforms(tmp_path: Path) -> None:
    check_source(lambda: Loggers(logs(tmp_path)), ONE)
    check_source(lambda: Loggers(logs(tmp_path), ("log2",)), ONE)


def test_a_problem_names_a_source_of_another_package(
    tmp_path: Path, plugged: Callable[[str], None]
) -> None:
    plugged("Loggers")
    source = logs(tmp_path)
    (tmp_path / "problem.toml").write_text(
        f'sampling_time = 0.5\ninputs = ["u"]\noutputs = ["y"]\n[data]\nsource = "{source}"\n'
        'guard = ["log2"]\n'
    )
    problem = load_problem(tmp_path)
    assert [t.name for t in problem.train] == ["log1"]
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, Seal(None)))
    assert load_lock(lock).data == problem.data == Loggers(source, ("log2",))


def test_a_source_without_training_records_is_refused(
    tmp_path: Path, plugged: Callable[[str], None]
) -> None:
    plugged("Loggers")
    (tmp_path / "problem.toml").write_text(
        'sampling_time = 0.5\ninputs = ["u"]\noutputs = ["y"]\n[data]\n'
        f'source = "loggers:{tmp_path}"\n'
    )
    with pytest.raises(UserError, match="has no training records"):
        load_problem(tmp_path)


class NoPlaces(DataSet):
    """Says nowhere where its records lie."""

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        return SourceData(())


def test_a_source_without_places_is_refused_at_once(plugged: Callable[[str], None]) -> None:
    plugged("NoPlaces")
    with pytest.raises(
        UserError, match=r"source 'loggers' of package made-up lacks places\(\): define it"
    ):
        source_class("loggers:x")
    with pytest.raises(TypeError, match=r"abstract method '?places"):
        NoPlaces("loggers:x")  # type: ignore[abstract]


def test_an_unknown_source_suggests_the_nearest(plugged: Callable[[str], None]) -> None:
    plugged("Loggers")
    with pytest.raises(UserError, match="did you mean 'loggers'"):
        source_class("logger:x")
    plugged("Path")
    with pytest.raises(UserError, match="is no class derived from"):
        source_class("loggers:x")


class HalfHidden(Loggers):
    def places(self, subset: Subset) -> tuple[Path, ...]:
        return super().places(subset) if subset == "train" else ()


class Restless(Loggers):
    calls: ClassVar[list[int]] = []

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        first, *_ = super().load(subset, channels).trajectories
        self.calls.append(len(self.calls))
        return SourceData((replace(first, y=first.y + len(self.calls)),))


class OneName(Loggers):
    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        first, *_ = super().load(subset, channels).trajectories
        return SourceData((first, first))


class Forgetful(Loggers):
    def to_toml(self) -> dict[str, object]:
        return {"source": "loggers"}


class Leaky(Loggers):
    def _files(self, subset: str) -> tuple[Path, ...]:
        return super()._files("train")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (HalfHidden, r"test1\.npy, which is in no place of places\('test'\)"),
        (Restless, "same at every reading"),
        (OneName, "2 train records are called 'log1'"),
        (Forgetful, "from_table must make an equal source"),
        (Leaky, "test record 'log1' is also training record 'log1'"),
    ],
)
def test_the_suite_refuses_what_does_not_conform(
    kind: type[Loggers], words: str, tmp_path: Path
) -> None:
    source = logs(tmp_path)
    with pytest.raises((AssertionError, UserError), match=words):
        check_source(lambda: kind(source), ONE)
