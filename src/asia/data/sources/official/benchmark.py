"""The source of the published benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from asia._nearest import nearest
from asia.data._digest import data_digest
from asia.data.sources.official.files import PublishedFile, benchmark_folder, check_files
from asia.data.sources.official.layouts import LAYOUTS, BenchmarkLayout
from asia.data.sources.source import Channels, DataSet, SourceData, Subset
from asia.errors import UserError


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
        """Implement `DataSet.load`.

        Raises:
            UserError: when a file is missing, is not the published one, or does not have the
                published layout
        """
        del channels
        layout = self._layout
        files = self._files(subset)
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
    def _layout(self) -> BenchmarkLayout:
        return LAYOUTS[self.argument]

    @property
    def _folder(self) -> Path:
        layout = self._layout
        return benchmark_folder(layout.folder, [f.path for f in (*layout.train, *layout.test)])

    def _files(self, subset: Literal["train", "test"]) -> tuple[PublishedFile, ...]:
        return self._layout.train if subset == "train" else self._layout.test
