"""Settings of tests/conftest.py and tests/unit/painting.py for the processes that tests start:
the quick linear reference, and pictures that are drawn but not painted.

Python imports this module where PYTHONPATH names its folder. Workers of the sandbox have an
environment of their own and do not.
"""

import importlib.abc
import importlib.util
import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any


def quick_reference(search: ModuleType) -> None:
    del search
    references = sys.modules["asia.judge.evaluation.references"]
    assert isinstance(references.LINEAR, str)
    references.LINEAR = Path(__file__).with_name("arx.py").read_text("utf-8")


def unpainted(figure: ModuleType) -> None:
    paint = figure.Figure.savefig

    def blank(self: Any, target: Any, **settings: object) -> None:
        if not hasattr(target, "write") or settings["format"] == "svg":
            # A file of a program that a test runs, or a picture that a browser shows.
            return paint(self, target, **settings)
        assert self.axes, "the picture shows nothing"
        return target.write(b"not painted")

    figure.Figure.savefig = blank
    figure.Figure.draw_without_rendering = lambda self: None


CHANGES: dict[str, Callable[[ModuleType], None]] = {
    "asia.search.run": quick_reference,
    "matplotlib.figure": unpainted,
}


class _Loader(importlib.abc.Loader):
    def __init__(self, real: importlib.abc.Loader, change: Callable[[ModuleType], None]) -> None:
        self.real, self.change = real, change

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.real.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self.real.exec_module(module)
        self.change(module)


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        change = CHANGES.pop(name, None)
        if change is None:
            return None
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        spec.loader = _Loader(spec.loader, change)
        return spec


sys.meta_path.insert(0, _Finder())
