"""Packages made up in a folder, which bring parts by entry point."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from asia import _plugins


@contextmanager
def installed(folder: Path, module: str, source: str, entry_points: str) -> Iterator[None]:
    """The module is importable, and its package installed with these entry points."""
    (folder / f"{module}.py").write_text(source)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    name = module.replace("_", "-")
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        _plugins._all_parts.cache_clear()
        yield
    _plugins._all_parts.cache_clear()
