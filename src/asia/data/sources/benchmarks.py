"""Data sets of the package nonlinear-benchmarks (https://github.com/GerbenBeintema/
nonlinear_benchmarks): the official loaders, offline where their cache is at hand."""

from __future__ import annotations

import contextlib
import io
import os
import socket
import warnings
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from asia._nearest import nearest
from asia.data._trajectory import Trajectory
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


@dataclass(frozen=True)
class _Cache:
    """Where the files of one benchmark are or will be."""

    root: Path
    name: str

    @property
    def archive(self) -> Path:
        return self.root / self.name / _FILES[self.name][0]

    @property
    def complete(self) -> bool:
        return self.archive.is_file() and (self.root / self.name / _FILES[self.name][1]).is_file()


def check_benchmark(name: str) -> None:
    """Raises UserError unless `name` is a benchmark with an official split."""
    if name not in _FILES:
        raise UserError(
            f"data.source: no benchmark '{name}' with a training and a test set"
            f"{nearest(name, _FILES)}"
        )


def benchmark_records(name: str, part: Literal["train", "test"]) -> tuple[Trajectory, ...]:
    """The official training or test records. The package's own initialisation window is not
    taken over: the protocol states what is skipped. Raises UserError when the data are neither
    cached nor to be had from the network."""
    check_benchmark(name)
    cache = _cache(name)
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
    return tuple(
        Trajectory(r.u, r.y, float(r.sampling_time), str(r.name))
        for r in (train if part == "train" else test)
    )


def cache_folder(name: str) -> Path:
    """Where the files of a benchmark are, or will be."""
    return _cache(name).archive.parent


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
        f"with ASIA_DATA_DIR set to a folder of yours (or into {cache.archive.parent})"
    )
