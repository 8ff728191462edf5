"""Test records in an encrypted store."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from asia.data.intake.conversion import as_written
from asia.data.intake.sheet import Wanted
from asia.data.intake.text import Text
from asia.data.sources.source import Channels, DataTable, Source, SourceData, Subset, TestSummary
from asia.data.store import PlainFile, SealHead, find_key, key_folder, open_store, read_seal
from asia.data.trajectory import Trajectory, unique_names
from asia.errors import UserError


@dataclass(frozen=True)
class SealedStore(Source):
    """The file that `asia init --seal` wrote. It holds a test and nothing else."""

    path: Path
    sha256: str | None = None
    keys: Path | None = field(default=None, compare=False)
    """Folder of keys; None for that of the user."""

    test_kept: ClassVar[str] = "encrypted; the search does not need its key"

    @classmethod
    def from_table(cls, table: DataTable, root: Path) -> Self:
        assert table.sealed is not None
        return cls((root / table.sealed.file).resolve(), table.sealed.sha256)

    def read(self, subset: Subset, channels: Channels) -> SourceData:
        """Implement `Source.read`. Raises UserError also without the key."""
        if subset != "test":
            return SourceData(())
        inputs, outputs = channels.names
        wanted = Wanted(tuple(inputs), tuple(outputs))
        files = open_store(self.path, key_folder(self.keys))
        found = [sealed_record(file, wanted, channels.sampling_time) for file in files]
        names = unique_names([record.name for record in found])
        return SourceData(tuple(replace(r, name=n) for r, n in zip(found, names, strict=True)))

    def places(self, subset: Subset) -> tuple[Path, ...]:
        """Return the folder of keys; the store reveals nothing without them."""
        return (key_folder(self.keys),) if subset == "test" else ()

    def to_toml(self) -> dict[str, Any]:
        return {"sealed": {"file": str(self.path), "sha256": self.sha256}}

    def outline(self, channels: Channels) -> TestSummary:
        """Return the outline from the public header, without the key."""
        head = self._head()
        inputs, outputs = channels.names
        for what, there, now in (
            ("inputs", ", ".join(head.inputs), ", ".join(inputs)),
            ("outputs", ", ".join(head.outputs), ", ".join(outputs)),
            ("sampling_time", f"{head.sampling_time!r} s", f"{channels.sampling_time!r} s"),
        ):
            if there != now:
                raise UserError(
                    f"{self.path} was sealed with {what} {there}, and the problem has {now}: put "
                    f"{what} back in problem.toml"
                )
        return TestSummary(
            sha256=head.sha256,
            names=unique_names([Path(file.name).stem for file in head.files]),
            lengths=tuple(file.samples for file in head.files),
            shared_samples=head.shared_samples,
            outside_inputs=head.outside_inputs,
        )

    def check_openable(self) -> None:
        find_key(self.path, self._head(), key_folder(self.keys))

    def with_keys(self, folder: Path | None) -> SealedStore:
        return replace(self, keys=folder)

    def _head(self) -> SealHead:
        head = read_seal(self.path)
        if head.sha256 != self.sha256:
            raise UserError(
                f"{self.path} holds other test data than the problem names: bring the store that "
                "was written with this problem.toml"
            )
        return head


def sealed_record(file: PlainFile, wanted: Wanted, sampling_time: float) -> Trajectory:
    """The record of a file in a store. Its time stamps were checked before it was sealed. Raises
    UserError."""
    sheet = Text().parse(Path(file.name), file.data, wanted)
    return as_written(sheet, wanted, sampling_time)
