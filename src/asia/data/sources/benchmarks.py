"""Data sets of the package nonlinear-benchmarks (https://github.com/GerbenBeintema/
nonlinear_benchmarks): the official loaders, offline where their cache is at hand."""

from __future__ import annotations

import contextlib
import io
import os
import socket
import warnings
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from asia._nearest import nearest
from asia.data._digest import data_digest
from asia.data._trajectory import Trajectory, unique_names
from asia.data.sources.source import Channels, DataSet, SourceData, Subset
from asia.errors import UserError

_DOWNLOAD_TIMEOUT_S = 20.0
# What each loader keeps in its cache: the file it downloads, and the file it reads from it.
_FILES = {
    "CED": ("FULLTEXT01.zip", "DATAUNIF.MAT"),
    "Cascaded_Tanks": ("CascadedTanksFiles.zip", "CascadedTanksFiles/dataBenchmark.mat"),
    "EMPS": ("EMPS.zip", "DATA_EMPS.mat"),
    "ParWH": ("ParWHFiles.zip", "ParWHFiles/ParWHData.mat"),
    "Silverbox": ("SilverboxFiles.zip", "SilverboxFiles/SNLS80mV.mat"),
    "WienerHammerBenchMark": ("WienerHammerBenchMark.mat", "WienerHammerBenchMark.mat"),
}
# The package downloads without checking certificates: these are the digests that the records, of
# training and of test, must have, as `data_digest` gives them.
PINS = {
    "Cascaded_Tanks": {
        "train": "a60c8ed462f90fc924dad58aed81fb0023c9601f0e490f55e45867a7e77bccef",
        "test": "93249423ff86424c734f80c9edea447aeb2bb046cba752815c019d5148e840ee",
    },
}


@dataclass(frozen=True)
class NonlinearBenchmark(DataSet):
    """A data set by the name of its loader, in its official division. The package's own
    initialisation window is not taken over: the protocol states what is skipped."""

    usage: ClassVar[str] = "nonlinear_benchmarks:<name>"
    public: ClassVar[bool] = True
    test_kept: ClassVar[str] = (
        "a public download: the plain files stay on this machine, isolation alone keeps "
        "candidates off them, and whoever knows the data set knows them"
    )

    def __post_init__(self) -> None:
        if self.argument not in _FILES:
            raise UserError(
                f"data.source: no benchmark '{self.argument}' with a training and a test set"
                f"{nearest(self.argument, _FILES)}"
            )

    def load(self, subset: Literal["train", "test"], channels: Channels) -> SourceData:
        """As `DataSet.load`. Raises UserError when the data are neither cached nor to be had from
        the network."""
        del channels
        cache = _cache(self.argument)
        had_archive = cache.archive.is_file()
        try:
            with _quiet():
                train, test = _load(cache)
        except Exception as error:  # the package raises bare Exception when a download fails
            if not had_archive:
                # A torn download would stand for the whole file at the next try.
                with contextlib.suppress(OSError):
                    cache.archive.unlink(missing_ok=True)
            raise UserError(_how_to_get(cache, error)) from error
        found = train if subset == "train" else test
        # Version 1.0.1 calls two test records of Silverbox alike.
        names = unique_names([str(r.name) for r in found])
        records = tuple(
            Trajectory(r.u, r.y, float(r.sampling_time), name)
            for r, name in zip(found, names, strict=True)
        )
        return SourceData(records, warnings=self._doubts(subset, records))

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """As `Source.places`: one file may hold all subsets."""
        return () if subset == "guard" and not self.guard else (_cache(self.argument).folder,)

    def _doubts(
        self, subset: Literal["train", "test"], records: Sequence[Trajectory]
    ) -> tuple[str, ...]:
        """What to say where nobody can tell whether the download is the real one. Raises UserError
        where it is not."""
        name, folder = self.argument, _cache(self.argument).folder
        if name == "ParWH":
            return (
                "the package nonlinear-benchmarks 1.0.1 interleaves the two periods of each ParWH "
                "record, so that every input occurs twice and the sampling time is wrong by 2: use "
                'source = "benchmark:parallel_wiener_hammerstein", which joins them',
            )
        if name not in PINS:
            return (
                f"the package nonlinear-benchmarks downloads {name} without checking the server's "
                "certificate, and ASIA knows no digest to compare it with: make sure that the "
                f"files in {folder} are the published ones",
            )
        if data_digest(records) != PINS[name][subset]:
            raise UserError(
                f"the {subset} records of benchmark {name} in {folder} are not the published ones "
                f"(sha256 {data_digest(records)[:12]}, expected {PINS[name][subset][:12]}): remove "
                "that folder and download them again, over a network you trust"
            )
        return ()


@dataclass(frozen=True)
class _Cache:
    """Where the files of one benchmark are or will be."""

    root: Path
    name: str

    @property
    def folder(self) -> Path:
        return self.root / self.name

    @property
    def archive(self) -> Path:
        return self.folder / _FILES[self.name][0]

    @property
    def complete(self) -> bool:
        return self.archive.is_file() and (self.folder / _FILES[self.name][1]).is_file()


def _load(cache: _Cache) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    import nonlinear_benchmarks

    loader: Any = getattr(nonlinear_benchmarks, cache.name)
    cache.root.mkdir(parents=True, exist_ok=True)
    train, test = loader(dir_placement=str(cache.root), atleast_2d=True)
    return _as_tuple(train), _as_tuple(test)


def _as_tuple(records: Any) -> tuple[Any, ...]:
    return tuple(records) if isinstance(records, (tuple, list)) else (records,)


def _cache(name: str) -> _Cache:
    own = os.environ.get("ASIA_DATA_DIR")
    if own:
        cache = _Cache(Path(own) / "nonlinear_benchmarks", name)
        if cache.complete:
            return cache
    return _Cache(Path.home() / ".nonlinear_benchmarks", name)


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT_S)
    sink = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(sink),
            contextlib.redirect_stderr(sink),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        socket.setdefaulttimeout(timeout)


def _how_to_get(cache: _Cache, error: Exception) -> str:
    archive, member = _FILES[cache.name]
    folder = f"$ASIA_DATA_DIR/nonlinear_benchmarks/{cache.name}/"
    unpacked = "" if archive == member else f" unpacked, so that {folder}{member} exists,"
    return (
        f"the data of benchmark {cache.name} are not on this machine and could not be downloaded "
        f"({str(error).partition(':')[0]}): get {archive} from "
        f"https://www.nonlinearbenchmark.org and put it into {folder},{unpacked} "
        f"with ASIA_DATA_DIR set to a folder of yours (or into {cache.folder})"
    )
