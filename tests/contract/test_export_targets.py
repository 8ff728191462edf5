"""Every export target passes its suite, and the suite fails for those that break a rule."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from asia.data.segment import SimulatedSegment
from asia.errors import UserError
from asia.export.model import ExportModel, Printed
from asia.export.pipeline import TARGETS, find_target, target_names
from asia.export.targets.numpy import NumpyTarget
from asia.testing import check_export_target
from tests.unit.made_up_parts import installed

PLUGGED = """
from asia.export.targets.numpy import NumpyTarget

class Copy(NumpyTarget):
    name = "copy"

made = Copy()
nothing = 3
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_every_built_in_target(name: str) -> None:
    missing = TARGETS[name].missing()
    if missing is not None:
        pytest.skip(missing)
    check_export_target(TARGETS[name])


class Offset(NumpyTarget):
    """Gives outputs that are 0.001 too low."""

    def print(self, model: ExportModel) -> Printed:
        (data,) = super().print(model).files.values()
        return Printed({"model.py": data.replace(b"    return y\n", b"    return y - 1e-3\n")})


class Remembering(NumpyTarget):
    """Prints the first model again and again."""

    def __init__(self) -> None:
        self.first: Printed | None = None

    def print(self, model: ExportModel) -> Printed:
        self.first = self.first or super().print(model)
        return self.first


class Counting(NumpyTarget):
    """Prints how often it has printed."""

    count = 0

    def print(self, model: ExportModel) -> Printed:
        self.count += 1
        (data,) = super().print(model).files.values()
        return Printed({"model.py": data + f"# {self.count}\n".encode()})


class Outside(NumpyTarget):
    def print(self, model: ExportModel) -> Printed:
        return Printed({"../model.py": b""})


class Refusing(NumpyTarget):
    def print(self, model: ExportModel) -> Printed:
        raise UserError("no")


class FirstWindow(NumpyTarget):
    def run(self, folder: Path, windows: Sequence[SimulatedSegment]):
        (found,) = super().run(folder, windows)
        return [replace(found, y_hat=found.y_hat[:1])]


class Absent(NumpyTarget):
    def missing(self) -> str | None:
        return "install it"


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (Offset, "the linear model, double: the files differ by"),
        (Remembering, "the other linear model, double: the files differ by"),
        (Counting, "model.py differs when printed again"),
        (Outside, "lies outside the folder"),
        (Refusing, "the linear model is refused"),
        (FirstWindow, "1 simulations of 2 windows"),
        (Absent, "cannot be checked here: install it"),
    ],
)
def test_the_suite_finds(broken: type[NumpyTarget], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_export_target(broken())


def test_a_target_of_another_package(tmp_path: Path) -> None:
    points = (
        "[asia.export_targets]\ncopy = copies:Copy\ncopy2 = copies:made\nnumber = copies:nothing"
    )
    with installed(tmp_path, "copies", PLUGGED, points):
        assert target_names() == (*TARGETS, "copy", "copy2", "number")
        check_export_target(find_target("copy"))
        with pytest.raises(UserError, match="calls itself 'copy': give it the name of its entry"):
            find_target("copy2")
        with pytest.raises(UserError, match=r"is 3, expected an asia\.export\.target\.Target"):
            find_target("number")
        with pytest.raises(UserError, match="'numpi' is unknown; did you mean 'numpy'"):
            find_target("numpi")
