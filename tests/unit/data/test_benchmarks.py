"""The official loaders on caches of the same layout with made-up numbers."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from asia.data import Signal, Trajectory
from asia.data.sources import Channels, Subset
from asia.data.sources.benchmarks import PINS, NonlinearBenchmark
from asia.errors import UserError


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache where ASIA_DATA_DIR points."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    root = tmp_path / "nonlinear_benchmarks"
    root.mkdir()
    return root


def records(name: str, subset: Subset, sampling_time: float = 4.0) -> tuple[Trajectory, ...]:
    channels = Channels((Signal("u"),), (Signal("y"),), sampling_time)
    source = NonlinearBenchmark(f"nonlinear_benchmarks:{name}")
    return source.records(subset, channels).trajectories


def column(seed: int, samples: int = 600) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((samples, 1))


def tanks(cache: Path) -> dict[str, np.ndarray]:
    """Made-up cascaded tanks in the cache."""
    folder = cache / "Cascaded_Tanks" / "CascadedTanksFiles"
    folder.mkdir(parents=True)
    (folder.parent / "CascadedTanksFiles.zip").touch()
    names = ("uEst", "yEst", "uVal", "yVal")
    arrays = {name: column(seed) for seed, name in enumerate(names)}
    savemat(folder / "dataBenchmark.mat", {**arrays, "Ts": 4.0})
    return arrays


def test_one_record_a_subset(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = tanks(cache)
    monkeypatch.delitem(PINS, "Cascaded_Tanks")
    (train,) = records("Cascaded_Tanks", "train")
    (test,) = records("Cascaded_Tanks", "test")
    assert np.array_equal(train.u, arrays["uEst"])
    assert np.array_equal(test.y, arrays["yVal"])
    assert train.sampling_time == 4.0
    assert capsys.readouterr() == ("", "")


def ced(cache: Path) -> dict[str, np.ndarray]:
    """Made-up coupled drives in the cache."""
    (cache / "CED").mkdir()
    (cache / "CED" / "FULLTEXT01.zip").touch()
    arrays = {name: column(seed, 500) for seed, name in enumerate(("u11", "u12", "z11", "z12"))}
    savemat(cache / "CED" / "DATAUNIF.MAT", arrays)
    return arrays


def test_several_records_a_subset(cache: Path) -> None:
    arrays = ced(cache)
    assert [len(t) for t in records("CED", "train", 0.02)] == [400, 400]
    second = records("CED", "test", 0.02)[1]
    assert np.array_equal(second.y, arrays["z12"][400:])


def test_incomplete_cache_says_what_is_missing(cache: Path, tmp_path: Path) -> None:
    home = tmp_path / "home" / ".nonlinear_benchmarks" / "Cascaded_Tanks"
    home.mkdir(parents=True)
    (home / "CascadedTanksFiles.zip").touch()
    with pytest.raises(UserError, match=r"CascadedTanksFiles/dataBenchmark\.mat exists"):
        records("Cascaded_Tanks", "train")


def test_unknown_benchmark() -> None:
    with pytest.raises(UserError, match="did you mean 'Silverbox'"):
        records("SilverBocks", "train")


def test_other_data_than_the_published_ones_are_refused(cache: Path) -> None:
    tanks(cache)
    for subset in ("train", "test"):
        with pytest.raises(UserError, match=f"the {subset} records .* not the published ones"):
            records("Cascaded_Tanks", subset)


def test_a_download_without_a_known_digest_is_a_warning(cache: Path) -> None:
    ced(cache)
    channels = Channels((Signal("u"),), (Signal("y"),), 0.02)
    found = NonlinearBenchmark("nonlinear_benchmarks:CED").records("train", channels)
    assert len(found.warnings) == 1
    assert "knows no digest" in found.warnings[0]


def test_records_of_one_name_are_told_apart(cache: Path) -> None:
    """The package calls two test records of Silverbox alike."""
    folder = cache / "Silverbox" / "SilverboxFiles"
    folder.mkdir(parents=True)
    (folder.parent / "SilverboxFiles.zip").touch()
    values = np.random.default_rng(0).standard_normal((1, 131072))
    savemat(folder / "SNLS80mV.mat", {"V1": values, "V2": values})
    names = [t.name for t in records("Silverbox", "test", 1 / 610.35)]
    assert names == [
        "test SB multisine",
        "test SB multisine_2",
        "test SB arrow no extrapolation",
    ]


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="ASIA_DATA_DIR is not set")
def test_the_published_tanks_are_known() -> None:
    (test,) = records("Cascaded_Tanks", "test")
    assert len(test) == 1024
