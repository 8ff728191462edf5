"""Layouts of the published files, and each benchmark's division into subsets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from asia.data._trajectory import Array, Trajectory
from asia.data.sources.official.files import PublishedFile

_Subset = Literal["train", "test"]

_SITE = "https://www.nonlinearbenchmark.org"
_TANKS = PublishedFile(
    "CascadedTanksFiles/dataBenchmark.mat",
    url="https://data.4tu.nl/file/d4810b78-6cdd-48fe-8950-9bd601e5f47f/"
    "3b697e42-01a4-4979-a370-813a456c36f5",
    zipped=True,
)
_FSM_RAW = (
    "https://raw.githubusercontent.com/merijnfloren/fsm-benchmark-data/"
    "c7b0e2c832e438d70e50df35b2db221618a1ec90/data"
)
_FSM_DIGESTS = {
    "u_100mV_test": "627a9b7b21d475451a1a9aa9144e54f638fc21c824c1a52aaca29b5869d7dc33",
    "u_100mV_train": "a53d6ee47ac1ea784c70e7634ce816467fb61effd8706eaf6b52f68142380a81",
    "u_200mV_test": "0053438fb9c6ae8ee46e0dd18838febe3183996f3ad3ae9eb8dfc3bdbaba7d18",
    "u_200mV_train": "59356f9b403b839231cf903acf6c99df33e0f4fbc820f4edd44dc169ac38dd3e",
    "u_300mV_test": "2bc566ae64d9000e69fbbc95092ac9c04c083bb398e4f16f2eb105645844e401",
    "u_300mV_train": "0436437998307e8f8c86f824c1fee4e225f212861878bf58d42b2a5e2ecd0cb5",
    "y_100mV_test": "a1541232b74db701f40df56e85b28a8d4cf5ea433bd7b3fc12d9196fa0e9770a",
    "y_100mV_train": "06892ff7fc943712898d7ca741205e4d6574bec2a20e69a0052f986c27bd10ad",
    "y_200mV_test": "7935a6b7251d9a87f1351a3cb71b6282c414b3156c227813bb1cb3ebde2cb7b4",
    "y_200mV_train": "b25b16b07fdbc7980bab4e98906ddaf2eaee41be0957c8911a469c3c426479d1",
    "y_300mV_test": "b46edea962a149b7a5abd89f819e6f1ec03ba4d68b0ac83e2a8fc84c2b0ebaf3",
    "y_300mV_train": "38acb224027e728d7a3c44a0ce5538fcb74c836be585a1b318a6728c8a6820fb",
}
_FSM_LEVELS = (100, 200, 300)
_F16_LEVELS: dict[_Subset, tuple[int, ...]] = {"train": (1, 3, 5, 7), "test": (2, 4, 6)}

# The Silverbox record, 0-based: the arrow, then ten realisations of a multisine of 8192 samples
# with 500 samples between them; the official division falls inside the eighth.
_ARROW = range(100, 40_575)
_ARROW_WITHIN = range(100, 32_100)
_MULTISINE_TRAIN = range(40_650, 105_712)
_MULTISINE_TEST = range(105_712, 127_400)
_FIRST_REALISATION, _REALISATION_STEP, _GAP = 40_986, 8_692, 500


@dataclass(frozen=True)
class BenchmarkLayout:
    """A benchmark: its files, and how they are read."""

    folder: str
    """Folder below `nonlinear_benchmarks`."""
    train: tuple[PublishedFile, ...]
    """The files with the training records."""
    test: tuple[PublishedFile, ...]
    """The files with the test records; some benchmarks have all records in one file."""
    read: Callable[[Path, _Subset], Iterator[Trajectory]]
    """The records of a subset, from the folder."""
    page: str
    """Web page of the files."""
    digests: Mapping[_Subset, str] = field(default_factory=dict["_Subset", str])
    """Digest of the records of a subset, as `data_digest` gives it, where that of the file is not
    known."""


def _mat(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    return loadmat(path)


def _record(u: Array, y: Array, sampling_time: float, name: str) -> Trajectory:
    return Trajectory(u, y, float(sampling_time), name)


def _ced(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Two records of 500 samples: the first 400 of each train, the last 100 test."""
    found = _mat(folder / "DATAUNIF.MAT")
    part = slice(None, 400) if subset == "train" else slice(400, None)
    for level, u, y in (("low", "u11", "z11"), ("high", "u12", "z12")):
        yield _record(found[u].ravel()[part], found[y].ravel()[part], 0.02, level)


def _cascaded_tanks(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    found = _mat(folder / _TANKS.path)
    u, y = (found[f"{signal}{'Est' if subset == 'train' else 'Val'}"][:, :1] for signal in "uy")
    yield _record(u, y, found["Ts"].item(), f"{subset} Cascaded_Tanks")


def _emps(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Force in N and position in m of one experiment a file; the test has pulses of load."""
    found = _mat(folder / ("DATA_EMPS.mat" if subset == "train" else "DATA_EMPS_PULSES.mat"))
    t = found["t"].ravel()
    step = (t[-1] - t[0]) / (len(t) - 1)
    name = "reference" if subset == "train" else "pulses"
    yield _record(found["vir"].ravel(), found["qm"].ravel(), step, name)


def _silverbox(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Training: the realisations one by one, cut in the middle of the gaps between them."""
    found = _mat(folder / "SilverboxFiles" / "SNLS80mV.mat")
    u, y = found["V1"].ravel(), found["V2"].ravel()
    parts = {
        "multisine": _MULTISINE_TEST,
        "arrow_full": _ARROW,
        "arrow_no_extrapolation": _ARROW_WITHIN,
    }
    if subset == "train":
        first = _FIRST_REALISATION - _GAP // 2
        inner = range(first + _REALISATION_STEP, _MULTISINE_TRAIN.stop, _REALISATION_STEP)
        edges = [_MULTISINE_TRAIN.start, *inner, _MULTISINE_TRAIN.stop]
        parts = {f"multisine{k}": range(*ends) for k, ends in enumerate(pairwise(edges), 1)}
    for name, part in parts.items():
        if part.stop > len(u):
            raise ValueError(f"{len(u)} samples, expected {_MULTISINE_TEST.stop} or more")
        yield _record(u[part.start : part.stop], y[part.start : part.stop], 1 / 610.35, name)


def _wiener_hammerstein(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    found = _mat(folder / "WienerHammerBenchMark.mat")
    part = slice(5_200, 105_200) if subset == "train" else slice(105_200, 184_000)
    u, y = found["uBenchMark"].ravel(), found["yBenchMark"].ravel()
    if len(u) < part.stop:
        raise ValueError(f"{len(u)} samples, expected {part.stop} or more")
    name = "filtered_noise" if subset == "train" else "filtered_noise_test"
    yield _record(u[part], y[part], 1.0 / found["fs"].item(), name)


def _fine_steering_mirror(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Arrays (samples, channels, realisations, periods); a record is a realisation at one level,
    its periods one after the other."""
    for level in _FSM_LEVELS:
        u, y = (np.load(folder / f"{s}_{level}mV_{subset}.npy", mmap_mode="r") for s in "uy")
        for k in range(u.shape[2]):
            name = f"{level}mV_{'realisation' if subset == 'train' else 'test'}{k + 1}"
            yield _record(_joined(u[:, :, k, :]), _joined(y[:, :, k, :]), 1 / 6400, name)


def _joined(periods: Array) -> Array:
    """(samples, channels, periods) as (samples * periods, channels), one period after the other."""
    return np.moveaxis(periods, 2, 0).reshape(-1, periods.shape[1])


def _parallel_wiener_hammerstein(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Arrays (samples, periods, phases, amplitudes), in the order of the phases. The periods follow
    each other, as in the baseline of the authors; nonlinear-benchmarks 1.0.1 interleaves them."""
    found = _mat(folder / "ParWHFiles" / "ParWHData.mat")
    u, y = (found[name] for name in (("uEst", "yEst") if subset == "train" else ("uVal", "yVal")))
    step = 1.0 / found["fs"].item()
    for phase in range(u.shape[2]):
        for level in range(u.shape[3]):
            name = f"phase{phase + 1:02d}_" if subset == "train" else ""
            us, ys = (_joined(a[:, None, :, phase, level]) for a in (u, y))
            yield _record(us, ys, step, f"{name}amplitude{level + 1}")


def _f16(folder: Path, subset: _Subset) -> Iterator[Trajectory]:
    """Force in N, and the first of three accelerations in m/s^2: that of the published results."""
    for file in _f16_files(subset):
        found = _mat(folder / file.path)
        name = Path(file.path).stem.removeprefix("F16Data_").removesuffix("_Validation")
        u, y = found["Force"].ravel(), found["Acceleration"][0]
        yield _record(u, y, 1.0 / found["Fs"].item(), name)


def _f16_files(subset: _Subset) -> tuple[PublishedFile, ...]:
    ending = "" if subset == "train" else "_Validation"
    return tuple(
        PublishedFile(f"F16GVT_Files/BenchmarkData/F16Data_{kind}_Level{level}{ending}.mat")
        for kind in ("FullMSine", "SineSw")
        for level in _F16_LEVELS[subset]
    )


def _fsm_files(subset: _Subset) -> tuple[PublishedFile, ...]:
    names = [f"{signal}_{level}mV_{subset}" for level in _FSM_LEVELS for signal in "uy"]
    return tuple(
        PublishedFile(f"{name}.npy", _FSM_DIGESTS[name], f"{_FSM_RAW}/{name}.npy") for name in names
    )


def _one_file(
    folder: str, file: PublishedFile, read: Callable[[Path, _Subset], Iterator[Trajectory]]
) -> BenchmarkLayout:
    return BenchmarkLayout(folder, (file,), (file,), read, _SITE)


LAYOUTS: dict[str, BenchmarkLayout] = {
    "cascaded_tanks": BenchmarkLayout(
        "Cascaded_Tanks",
        (_TANKS,),
        (_TANKS,),
        _cascaded_tanks,
        _SITE,
        {
            "train": "a60c8ed462f90fc924dad58aed81fb0023c9601f0e490f55e45867a7e77bccef",
            "test": "93249423ff86424c734f80c9edea447aeb2bb046cba752815c019d5148e840ee",
        },
    ),
    "ced": _one_file("CED", PublishedFile("DATAUNIF.MAT"), _ced),
    "emps": BenchmarkLayout(
        "EMPS",
        (PublishedFile("DATA_EMPS.mat", "6cf6814a...cf7e"),),
        (PublishedFile("DATA_EMPS_PULSES.mat", "0eab75bb...1704"),),
        _emps,
        _SITE,
    ),
    "silverbox": _one_file(
        "Silverbox",
        PublishedFile("SilverboxFiles/SNLS80mV.mat", "5c7413a5...77ed4"),
        _silverbox,
    ),
    "wiener_hammerstein": _one_file(
        "WienerHammerBenchMark", PublishedFile("WienerHammerBenchMark.mat"), _wiener_hammerstein
    ),
    "fine_steering_mirror": BenchmarkLayout(
        "FineSteeringMirror",
        _fsm_files("train"),
        _fsm_files("test"),
        _fine_steering_mirror,
        "https://github.com/merijnfloren/fsm-benchmark-data",
    ),
    "parallel_wiener_hammerstein": _one_file(
        "ParWH", PublishedFile("ParWHFiles/ParWHData.mat"), _parallel_wiener_hammerstein
    ),
    "f16": BenchmarkLayout("F16", _f16_files("train"), _f16_files("test"), _f16, _SITE),
}
"""The benchmarks by name."""
