"""The official loaders on caches of the same layout with made-up numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from asia.data.sources.benchmarks import benchmark_records
from asia.errors import UserError


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache where ASIA_DATA_DIR points."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    root = tmp_path / "nonlinear_benchmarks"
    root.mkdir()
    return root


def column(seed: int, samples: int = 600) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((samples, 1))


def test_one_record_a_part(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = cache / "Cascaded_Tanks" / "CascadedTanksFiles"
    folder.mkdir(parents=True)
    (folder.parent / "CascadedTanksFiles.zip").touch()
    names = ("uEst", "yEst", "uVal", "yVal")
    arrays = {name: column(seed) for seed, name in enumerate(names)}
    savemat(folder / "dataBenchmark.mat", {**arrays, "Ts": 4.0})
    (train,) = benchmark_records("Cascaded_Tanks", "train")
    (test,) = benchmark_records("Cascaded_Tanks", "test")
    assert np.array_equal(train.u, arrays["uEst"])
    assert np.array_equal(test.y, arrays["yVal"])
    assert train.sampling_time == 4.0
    assert capsys.readouterr() == ("", "")


def test_several_records_a_part(cache: Path) -> None:
    (cache / "CED").mkdir()
    (cache / "CED" / "FULLTEXT01.zip").touch()
    arrays = {name: column(seed, 500) for seed, name in enumerate(("u11", "u12", "z11", "z12"))}
    savemat(cache / "CED" / "DATAUNIF.MAT", arrays)
    assert [len(t) for t in benchmark_records("CED", "train")] == [400, 400]
    second = benchmark_records("CED", "test")[1]
    assert np.array_equal(second.y, arrays["z12"][400:])


def test_incomplete_cache_says_what_is_missing(cache: Path, tmp_path: Path) -> None:
    home = tmp_path / "home" / ".nonlinear_benchmarks" / "Cascaded_Tanks"
    home.mkdir(parents=True)
    (home / "CascadedTanksFiles.zip").touch()
    with pytest.raises(UserError, match=r"CascadedTanksFiles/dataBenchmark\.mat exists"):
        benchmark_records("Cascaded_Tanks", "train")


def test_unknown_benchmark() -> None:
    with pytest.raises(UserError, match="did you mean 'Silverbox'"):
        benchmark_records("SilverBocks", "train")
