"""An export target: the programs of a model as JSON, for an interpreter in another language."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Sequence
from pathlib import Path

from asia.data.segment import SimulatedSegment
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers
from asia.lowering.evaluation import simulate
from asia.lowering.program import LoweredModel
from asia.lowering.wire import pack, unpack

_FILE = "program.json"


class JsonTarget:
    """`program.json`: facts about the model and its packed program."""

    name = "json"
    usage = "`program.json` holds the facts of the model and its program, packed and in base64."

    def missing(self) -> str | None:
        """Nothing has to be installed."""
        return None

    def print(self, model: ExportModel) -> Printed:
        """Write the facts and the packed program."""
        program = base64.b64encode(pack(model.lowered)).decode()
        return Printed({_FILE: json.dumps({**model.facts(), "program": program}).encode()})

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate each window with the program in the file."""
        packed = json.loads((folder / _FILE).read_text())["program"]
        model = unpack(base64.b64decode(packed))
        assert isinstance(model, LoweredModel)
        begin = time.perf_counter()
        y_hat = tuple(simulate(model, w.past_u, w.past_y, w.u) for w in windows)
        return [Answers("double", y_hat, time.perf_counter() - begin)]
