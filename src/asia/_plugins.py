"""The only module that imports by name: parts of installed packages, by their entry points; parts
that the user names as `module:Name`; libraries and families. No name is read from a file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, LiteralString

from asia.errors import UserError

GROUPS = (
    "asia.families",
    "asia.agents",
    "asia.sources",
    "asia.metrics",
    "asia.executors",
    "asia.sinks",
    "asia.export_targets",
    "asia.validation_checks",
    "asia.commands",
    "asia.command_options",
    "asia.report_sections",
)
OWN = "asia-sysid"
"""The package of ASIA, which brings parts by the same entry points as others."""


def library(name: LiteralString) -> Any:
    """Import a module whose name is in the source. Raises ImportError."""
    return import_module(name)


def is_installed(name: LiteralString) -> bool:
    """Return whether a library can be imported, without importing it."""
    return find_spec(name) is not None


def version_of(name: str) -> str:
    """Return the version of an installed package; "missing" where there is none."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def family_module(package: str, name: str) -> Any:
    """Import the module of a family of ASIA or of an installed package.

    Raises:
        UserError: for a package that brings no parts
    """
    if package.partition(".")[0] not in ("asia", *_package_names()):
        raise UserError(f"there is no family {name} in an installed package {package}")
    return import_module(f"{package}.{name}")


@dataclass(frozen=True)
class Part:
    """A part of another package."""

    group: str
    """The kind of part, one of `GROUPS`."""
    name: str
    """Name in problem files and on the command line."""
    target: str
    """Definition of the part, `module:Name`."""
    package: str
    version: str

    def load(self) -> object:
        """The part itself. Raises UserError when its module cannot be imported or lacks it."""
        return load_target(self.target, f"{self.name} of package {self.package} {self.version}")

    def why_not(self) -> str | None:
        """Why it cannot be loaded; None when it can."""
        try:
            self.load()
        except UserError as error:
            return str(error)
        return None


def load_target(target: str, what: str) -> object:
    """The object at `module:Name`. what: its description in messages. Raises UserError when the
    text has another form, the module cannot be imported, or it has no such name."""
    module, _, name = target.partition(":")
    if not module or not name:
        raise UserError(f"{what}: '{target}' has no such form: expected 'module:Name'")
    try:
        found: object = import_module(module)
    # Code of another package: whatever it raises is its failure, not ours.
    except Exception as error:
        raise UserError(
            f"{what}: cannot import {module}: {type(error).__name__}: {error}"
        ) from error
    for attribute in name.split("."):
        if not hasattr(found, attribute):
            raise UserError(f"{what}: module {module} has no '{name}'")
        found = getattr(found, attribute)
    return found


def parts() -> tuple[Part, ...]:
    """Return the parts of all installed packages, by kind and name. Reads metadata, imports
    nothing.

    Raises:
        UserError: two packages bring a part of the same kind and name.
    """
    found: dict[tuple[str, str], Part] = {}
    for part in _all_parts():
        other = found.setdefault((part.group, part.name), part)
        if other.package != part.package:
            raise UserError(
                f"packages {other.package} and {part.package} both bring '{part.name}' in "
                f"{part.group}: uninstall one of them"
            )
    return tuple(sorted(found.values(), key=lambda p: (GROUPS.index(p.group), p.name)))


def parts_of(group: str) -> tuple[Part, ...]:
    """The parts of one kind, by name. Raises UserError as `parts` does."""
    return tuple(part for part in parts() if part.group == group)


def ordered(names: Sequence[str], after: Mapping[str, str | None]) -> list[str]:
    """Return names with those of plug-ins among them.

    Args:
        after: for each name of a plug-in the name that it follows; at the end without one
    """
    found, waiting = [*names], dict(after)
    while placed := [name for name, other in waiting.items() if other in found]:
        for name in placed:
            found.insert(found.index(str(waiting.pop(name))) + 1, name)
    return [*found, *waiting]


@dataclass(frozen=True)
class PluginPackage:
    """An importable package, or a single module, that brings parts."""

    name: str
    """Name for import."""
    places: tuple[Path, ...]
    """Its own folder or file, and not the folder that holds it; the folders of a package without
    `__init__.py`, which can be more than one."""


def _package_names() -> tuple[str, ...]:
    """Top-level names of other packages, whether or not the parts' own names clash."""
    others = (part.target for part in _all_parts() if part.package != OWN)
    return tuple(dict.fromkeys(re.split("[:.]", target)[0] for target in others))


def plugin_packages() -> tuple[PluginPackage, ...]:
    """The packages that bring parts, for workers to read: candidates import from them. One that
    cannot be found is left out: to use its part says so."""
    found: list[PluginPackage] = []
    for name in _package_names():
        try:
            spec = find_spec(name)
        except (ImportError, ValueError):
            continue
        if spec is None:
            continue
        places = spec.submodule_search_locations
        if places is None:
            places = [spec.origin] if spec.has_location and spec.origin else []
        if places:
            package = PluginPackage(name, tuple(Path(place).absolute() for place in places))
            found.append(package)
    return tuple(found)


@cache
def _all_parts() -> tuple[Part, ...]:
    from importlib.metadata import distributions

    # The metadata of an editable install can lie on the path twice; the first one counts.
    return tuple(
        Part(point.group, point.name, point.value, one.metadata["Name"], one.version)
        for one in distributions()
        for point in one.entry_points
        if point.group in GROUPS
    )
