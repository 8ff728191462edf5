"""Simulator of the user's own: a Python function or an FMU, and the unknowns to calibrate."""

from __future__ import annotations

import ast
import hashlib
import inspect
import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from asia._files import read_file
from asia._syntax import syntax_tree
from asia._text import nearest
from asia.errors import UserError

_ARGUMENTS, _STEP = 4, "x, u, params, dt"
_UNIT_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True)
class Unknown:
    """Search range of a parameter or an initial state of a simulator."""

    min: float
    """Least value; above 0 the range is searched on a log scale."""
    max: float
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.min < self.max:
            raise ValueError(f"is a range from {self.min:g} to {self.max:g}: min must be below max")


@dataclass(frozen=True, kw_only=True)
class PlantTable:
    """[plant] of problem.toml."""

    source: str
    """`plant.py:simulate`, a function in a file beside the problem, or `model.fmu`; with [control]
    `plant.py:step`, or an FMU for co-simulation."""
    parameters: Mapping[str, Unknown] = field(default_factory=dict[str, Unknown])
    """Parameters of the simulator, the same in every record; with [control] drawn for each
    scenario."""
    initial: Mapping[str, Unknown] = field(default_factory=dict[str, Unknown])
    """Initial states, estimated for each record; with [control] drawn for each scenario."""


_PROBLEMS = Path(__file__).resolve().parents[1] / "problems"


@dataclass(frozen=True, kw_only=True)
class Plant(PlantTable):
    """Simulator with the content of its file. Its code runs in the sandbox alone."""

    code: bytes = field(repr=False)
    """Content of the file."""

    @property
    def is_unit(self) -> bool:
        """Whether it is an FMU."""
        return self.source.endswith(".fmu")

    @property
    def is_built_in(self) -> bool:
        """Whether it comes with ASIA, so that it needs no sandbox."""
        # Resolved, so that no path leads through the folder of the problems and out of it again.
        file = Path(self.source.rpartition(":")[0] or self.source).resolve()
        return _PROBLEMS in file.parents and file.read_bytes() == self.code

    @property
    def function(self) -> str:
        """Name of the Python function; "" for an FMU."""
        return "" if self.is_unit else self.source.rpartition(":")[2]

    @property
    def label(self) -> str:
        """Source without the folder."""
        return os.path.basename(self.source)

    @property
    def table(self) -> dict[str, Any]:
        """[plant] of problem.toml."""
        known = ((name, asdict(self)[name]) for name in ("source", "parameters", "initial"))
        return {name: value for name, value in known if value}

    @property
    def digest(self) -> str:
        """Hex sha256 of the code and the name of the function."""
        return hashlib.sha256(self.code + b"\0" + self.function.encode()).hexdigest()

    @property
    def folder(self) -> Path:
        """Folder of the unpacked FMU, which workers may read."""
        return units_folder() / self.digest

    def unpack(self) -> None:
        """Unpack an FMU where workers may read it; does nothing for a Python function.

        Raises:
            UserError: for an archive that is too large or damaged, or a folder that cannot be made.
        """
        if not self.is_unit or self.folder.is_dir():
            return
        try:
            units_folder().mkdir(parents=True, exist_ok=True)
            made = Path(tempfile.mkdtemp(dir=units_folder()))
            with zipfile.ZipFile(io.BytesIO(self.code)) as archive:
                if sum(one.file_size for one in archive.infolist()) > _UNIT_BYTES:
                    raise UserError(f"[plant] source: {self.label} is over 512 MB when unpacked")
                archive.extractall(made)
            made.chmod(0o755)
            try:
                made.rename(self.folder)
            except OSError:  # another process was faster
                shutil.rmtree(made)
        except (OSError, zipfile.BadZipFile) as error:
            raise UserError(f"[plant] source: cannot unpack {self.label}: {error}") from error


def units_folder() -> Path:
    """Folder of unpacked FMUs, outside and inside of a sandbox."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("ASIA_UNITS") or Path(cache) / "asia" / "units").absolute()


def plant_file(table: Mapping[str, Any]) -> tuple[dict[str, Any], str, bytes]:
    """Return [plant] with a source beside the problem file, the name of that file, and its content.

    Args:
        table: [plant] of the problem file; `source` may be a Python function, and paths are
            relative to the working directory.

    Raises:
        UserError: for a function that is not in a file, and a file that is missing.
    """
    source: Any = table.get("source", "")
    if callable(source):
        file, name = inspect.getsourcefile(source), getattr(source, "__qualname__", "")
        if file is None or not os.path.isfile(file) or not name.isidentifier():
            raise UserError(
                f"plant source {name or source} is not at the top level of a Python file: write it "
                "to one, and give 'plant.py:function'"
            )
        source = f"{file}:{name}"
    path, function = _parts(str(source))
    content = read_file(Path(path).absolute(), "plant names it: put the simulator there")
    file = os.path.basename(path)
    return {**table, "source": f"{file}:{function}" if function else file}, file, content


def _parts(source: str) -> tuple[str, str]:
    """Return file and function of a source; no function for an FMU."""
    if source.endswith(".fmu"):
        return source, ""
    file, _, function = source.rpartition(":")
    if not file or not function.isidentifier():
        raise UserError(
            f"[plant] source is '{source}', expected 'plant.py:simulate', a function in a "
            "file beside the problem, or 'model.fmu'"
        )
    return file if file.endswith(".py") else f"{file}.py", function


def load_plant(
    table: PlantTable,
    root: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    calibrated: bool = True,
) -> Plant:
    """Read a simulator without executing it.

    Args:
        table: [plant] of the problem file.
        root: folder of the problem file.
        inputs, outputs: names of the signals.
        calibrated: whether its parameters are fitted, so that there must be one.

    Raises:
        UserError: for a file that is missing or no simulator, and unknowns that do not fit it.
    """
    if not table.parameters and calibrated:
        raise UserError("[plant.parameters] is empty: name a parameter to fit, with min and max")
    for name in table.initial:
        if name in table.parameters:
            raise UserError(f"'{name}' is in [plant.parameters] and [plant.initial]: keep one")
    file, function = _parts(table.source)
    is_unit = not function
    path = (root / file).absolute()
    code = read_file(path, "[plant] names it: put the simulator there")
    source = str(path) if is_unit else f"{path}:{function}"
    plant = Plant(source=source, parameters=table.parameters, initial=table.initial, code=code)
    if is_unit:
        _check_unit(plant, inputs, outputs, stepped=not calibrated)
        plant.unpack()
    else:
        _check_function(code, path, function, "u, params, x0, dt" if calibrated else _STEP)
    return plant


def _check_function(code: bytes, path: Path, function: str, arguments: str) -> None:
    try:
        tree = syntax_tree(code.decode("utf-8"), path.name)
    except (SyntaxError, ValueError) as error:
        raise UserError(f"[plant] source: {path.name} is not valid Python: {error}") from error
    defined = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    if function not in defined:
        raise UserError(
            f"[plant] source: {path.name} defines no top-level function '{function}'"
            f"{nearest(function, list(defined))}"
        )
    known = defined[function].args
    if not known.vararg and len(known.posonlyargs) + len(known.args) != _ARGUMENTS:
        raise UserError(
            f"[plant] source: {function} in {path.name} takes "
            f"{len(known.posonlyargs) + len(known.args)} arguments, expected 4: "
            f"{function}({arguments})"
        )


def _check_unit(
    plant: Plant, inputs: Sequence[str], outputs: Sequence[str], *, stepped: bool
) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(plant.code)) as archive:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    except (zipfile.BadZipFile, KeyError, ElementTree.ParseError) as error:
        raise UserError(f"[plant] source: {plant.label} is no FMU: {error}") from error
    if stepped and root.find("CoSimulation") is None:
        raise UserError(
            f"[plant] source: {plant.label} has no co-simulation, which [control] needs: export it "
            "with co-simulation"
        )
    variables = [v.get("name", "") for part in root.iter("ModelVariables") for v in part]
    for table, names in (
        ("inputs", inputs),
        ("outputs", outputs),
        ("[plant.parameters]", plant.parameters),
        ("[plant.initial]", plant.initial),
    ):
        for name in names:
            if name not in variables:
                raise UserError(
                    f"{table}: {plant.label} has no variable '{name}'{nearest(name, variables)}"
                )
