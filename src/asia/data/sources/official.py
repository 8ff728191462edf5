"""Benchmarks of nonlinearbenchmark.org, read from the published files."""

import hashlib
import os
import re
import shutil
import tempfile
import urllib.request
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from asia._text import nearest
from asia.data.sources.source import Channels, DataSet, SourceData, Subset
from asia.data.trajectory import Array, Trajectory, data_digest
from asia.errors import UserError

# Published files on this machine: where they lie, whether they are the published ones.


@dataclass(frozen=True)
class PublishedFile:
    """One file of a benchmark."""

    path: str
    """Path in the folder of its benchmark."""
    sha256: str = ""
    """Digest, or its first and last digits with `...` between them; "" where none is known."""
    url: str = ""
    """Address of the download; "" where a download cannot be verified."""
    zipped: bool = False
    """Whether `url` is a zip archive that holds `path`; its records have a digest then."""

    def __post_init__(self) -> None:
        assert not self.url or self.zipped or re.fullmatch("[0-9a-f]{64}", self.sha256)

    def is_digest(self, found: str) -> bool:
        """Return whether `found` can be the digest of this file."""
        first, _, last = self.sha256.partition("...")
        return found.startswith(first) and found.endswith(last)


def is_lfs_pointer(path: Path) -> bool:
    """Return whether git-lfs has not fetched the content of a file
    (https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md)."""
    with path.open("rb") as stream:
        return stream.read(23) == b"version https://git-lfs"


def benchmark_folder(name: str, paths: Sequence[str]) -> Path:
    """The folder of a benchmark: in $ASIA_DATA_DIR/nonlinear_benchmarks when one of its files is
    there, else in ~/.nonlinear_benchmarks, as the package nonlinear-benchmarks has it."""
    own = os.environ.get("ASIA_DATA_DIR")
    if own:
        folder = Path(own) / "nonlinear_benchmarks" / name
        if any((folder / path).is_file() for path in paths):
            return folder
    return Path.home() / ".nonlinear_benchmarks" / name


def check_files(
    name: str, folder: Path, files: Sequence[PublishedFile], page: str
) -> tuple[str, ...]:
    """Check the files of a benchmark against their published digests.

    A missing file is downloaded where the download can be verified.

    Returns:
        warnings about files that may not be the published ones

    Raises:
        UserError: for a file that is missing, that git-lfs has not fetched, or that has another
            digest than the published one
    """
    for file in files:
        path = folder / file.path
        if path.is_file():
            continue
        problem = _download(file, path) if file.url else "no download of it is pinned by a digest"
        if problem:
            raise UserError(
                f"the data of benchmark {name} are not on this machine, for {file.path} is missing "
                f"and {problem}: get it from {page} and put it, unpacked, at "
                f"$ASIA_DATA_DIR/nonlinear_benchmarks/{folder.name}/{file.path} with ASIA_DATA_DIR "
                f"set to a folder of yours (or at {path})"
            )
    unknown: list[str] = []
    for file in files:
        path = folder / file.path
        if is_lfs_pointer(path):
            raise UserError(
                f"{path} is a pointer of git-lfs and not the file itself: install git-lfs, run git "
                "lfs pull in the clone it came from, and copy it again"
            )
        found = _sha256(path)
        if not file.sha256:
            unknown.append(f"{file.path} {found}")
        elif not file.is_digest(found):
            raise UserError(
                f"{path} is not the published file (sha256 {found[:12]}..., expected "
                f"{file.sha256[:8]}...): remove it and get it again, over a network you trust"
            )
    if not unknown:
        return ()
    return (
        f"no published digest of these files of {name} is known: compare their sha256 with those "
        f"of somebody who has them, or make sure where yours came from: {', '.join(unknown)}",
    )


def _sha256(path: Path) -> str:
    state = path.stat()
    return _sha256_of(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=64)
def _sha256_of(path: Path, changed: int, size: int) -> str:
    """Read once for each state of the file."""
    del changed, size
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _download(file: PublishedFile, path: Path) -> str:
    """Download a file to `path` if its digest matches; else return the reason."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(dir=path.parent) as folder,
            urllib.request.urlopen(file.url, timeout=60.0) as answer,
        ):
            arrived = Path(folder) / path.name
            with arrived.open("wb") as target:
                shutil.copyfileobj(answer, target)
            if file.zipped:
                with zipfile.ZipFile(arrived) as archive:
                    arrived = Path(archive.extract(file.path, folder))
            elif _sha256(arrived) != file.sha256:
                return f"{file.url} holds other bytes than those published"
            arrived.replace(path)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        return f"the download failed ({error})"
    return ""


# Layouts of the published files, and each benchmark's division into subsets.


_Subset = Literal["train", "test"]

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


@dataclass(frozen=True)
class BenchmarkLayout:
    """A benchmark: its files, and how they are read."""

    folder: str
    """Folder below `nonlinear_benchmarks`."""
    train: tuple[PublishedFile, ...]
    test: tuple[PublishedFile, ...]
    """The files with the test records; some benchmarks have all records in one file."""
    read: Callable[[Path, _Subset], Iterator[Trajectory]]
    page: str = "https://www.nonlinearbenchmark.org"
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
    """The record has an arrow, then ten realisations of a multisine of 8192 samples with 500
    samples between them; the official division falls inside the eighth. Training: the realisations
    one by one, cut in the middle of the gaps between them."""
    found = _mat(folder / "SilverboxFiles" / "SNLS80mV.mat")
    u, y = found["V1"].ravel(), found["V2"].ravel()
    start, split, stop = 40_650, 105_712, 127_400
    parts = {
        "multisine": range(split, stop),
        "arrow_full": range(100, 40_575),
        "arrow_no_extrapolation": range(100, 32_100),
    }
    if subset == "train":
        edges = [start, *range(40_986 - 250 + 8_692, split, 8_692), split]
        parts = {f"multisine{k}": range(*ends) for k, ends in enumerate(pairwise(edges), 1)}
    for name, part in parts.items():
        if part.stop > len(u):
            raise ValueError(f"{len(u)} samples, expected {stop} or more")
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
    levels, ending = ((1, 3, 5, 7), "") if subset == "train" else ((2, 4, 6), "_Validation")
    return tuple(
        PublishedFile(f"F16GVT_Files/BenchmarkData/F16Data_{kind}_Level{level}{ending}.mat")
        for kind in ("FullMSine", "SineSw")
        for level in levels
    )


def _fsm_files(subset: _Subset) -> tuple[PublishedFile, ...]:
    names = [f"{signal}_{level}mV_{subset}" for level in _FSM_LEVELS for signal in "uy"]
    return tuple(
        PublishedFile(f"{name}.npy", _FSM_DIGESTS[name], f"{_FSM_RAW}/{name}.npy") for name in names
    )


def _one_file(
    folder: str, file: PublishedFile, read: Callable[[Path, _Subset], Iterator[Trajectory]]
) -> BenchmarkLayout:
    return BenchmarkLayout(folder, (file,), (file,), read)


LAYOUTS: dict[str, BenchmarkLayout] = {
    "cascaded_tanks": BenchmarkLayout(
        "Cascaded_Tanks",
        (_TANKS,),
        (_TANKS,),
        _cascaded_tanks,
        digests={
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
    ),
    "silverbox": _one_file(
        "Silverbox", PublishedFile("SilverboxFiles/SNLS80mV.mat", "5c7413a5...77ed4"), _silverbox
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
    "f16": BenchmarkLayout("F16", _f16_files("train"), _f16_files("test"), _f16),
}
"""The benchmarks by name."""


# The source of the published benchmarks.


@dataclass(frozen=True)
class OfficialBenchmark(DataSet):
    """A benchmark by name, its files read in the official division."""

    usage: ClassVar[str] = "benchmark:<name>"
    public: ClassVar[bool] = True
    test_kept: ClassVar[str] = (
        "a public download: the plain files stay on this machine, protected from candidates by "
        "isolation only, and known to anyone who knows the data set"
    )

    def __post_init__(self) -> None:
        if self.argument not in LAYOUTS:
            hint = nearest(self.argument, LAYOUTS)
            raise UserError(f"data.source: no benchmark '{self.argument}'{hint}")

    @property
    def argument(self) -> str:
        """Name of the benchmark. `nonlinear_benchmarks:Cascaded_Tanks` is an older form."""
        name = super().argument
        return name.lower() if self.source.startswith("nonlinear_benchmarks:") else name

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        """Implement `DataSet.load`. Raises UserError when a file is missing, is not the published
        one, or does not have the published layout."""
        del channels
        layout = LAYOUTS[self.argument]
        files = layout.train if subset == "train" else layout.test
        warnings = check_files(self.argument, self._folder, files, layout.page)
        try:
            records = tuple(layout.read(self._folder, subset))
        except (KeyError, IndexError, TypeError, ValueError, OSError, NotImplementedError) as error:
            raise UserError(
                f"{', '.join(str(self._folder / f.path) for f in files[:3])}: not laid out as "
                f"{self.argument} is published ({type(error).__name__}: {error}); get the files "
                f"from {layout.page} again"
            ) from error
        expected = layout.digests.get(subset)
        if expected is not None and data_digest(records) != expected:
            raise UserError(
                f"the {subset} records of {self.argument} in {self._folder} are not the published "
                f"ones (sha256 {data_digest(records)[:12]}, expected {expected[:12]}): remove that "
                f"folder and get the files from {layout.page} again"
            )
        return SourceData(records, warnings=() if expected else warnings)

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """Return the folder, for one file may hold all subsets, and the archive next to it."""
        return () if subset == "guard" and not self.guard else (self._folder,)

    @property
    def _folder(self) -> Path:
        layout = LAYOUTS[self.argument]
        return benchmark_folder(layout.folder, [f.path for f in (*layout.train, *layout.test)])
