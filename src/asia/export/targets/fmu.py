"""Functional mock-up units for co-simulation, FMI 2.0 and 3.0."""

import io
import platform
import re
import sys
import tempfile
import time
import uuid
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from asia._plugins import is_installed
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array
from asia.errors import InternalError
from asia.export.model import ExportModel, Printed
from asia.export.target import Answers
from asia.export.targets.c import c_compiler, c_source, compile_c, header, template

# Functions of the FMI standard around the printed C, for each version. The tables `fmi2.txt` and
# `fmi3.txt` have a row "name(arguments) | body" for each; m is the unit.


def shell(values: Sequence[float], version: int, token: str) -> str:
    """Text of `fmi.c`.

    Args:
        values: start values of the variables, in the order of their references.
        version: FMI version, 2 or 3.
        token: instantiation token of the unit.
    """
    starts = ",\n        ".join(map(repr, values))
    lines = [template("fmi.c", STARTS=starts, TOKEN=token, VERSION=version)]
    for line in template(f"fmi{version}.txt").splitlines():
        head, _, body = line.partition(" | ")
        lines.append(_function(head, body) if body else line)
    if version == 3:
        lines += [_function(*row) for row in _others()]
    return "\n".join([*lines, ""])


def _function(head: str, body: str) -> str:
    inside = head[head.index("(") + 1 : -1]
    names = [] if inside == "void" else re.findall(r"\*?(\w+)(?:,|$)", inside)
    unused = [f"(void){n};" for n in names if not re.search(rf"\b{n}\b", body)]
    return f"EXPORT {head};\nEXPORT {head}\n{{\n    {' '.join([*unused, body])}\n}}"


def _others() -> list[tuple[str, str]]:
    """Getters and setters of the types that the model does not have."""
    kinds = "Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String Binary Clock"
    sizes = {"Binary": "P m, R r, N n, N *s, P v, N k", "Clock": "P m, R r, N n, B *v"}
    rows: list[tuple[str, str]] = []
    for kind in kinds.split():
        arguments = sizes.get(kind, "P m, R r, N n, P v, N k")
        for way in ("Get", "Set"):
            rows.append((f"I fmi3{way}{kind}({arguments})", "return n ? ERROR : OK;"))
    for way in (
        "GetIntervalDecimal", "GetIntervalFraction", "GetShiftDecimal", "GetShiftFraction",
        "SetIntervalFraction", "SetShiftFraction", "SetIntervalDecimal", "SetShiftDecimal",
    ):  # fmt: skip
        arguments = "P m, R r, N n, P a"
        if way not in ("SetIntervalDecimal", "SetShiftDecimal"):
            arguments += ", P b"
        rows.append((f"I fmi3{way}({arguments})", "return ERROR;"))
    return rows


# Functional mock-up units for co-simulation, FMI 2.0 and 3.0: the printed C with a small shell.
#
# Outputs are computed when they are read, from the state of the sample and the inputs that are
# set, so that row k of a result holds sample k. A master that reads them before it sets the inputs
# of the sample sees a direct effect of the input one step late.


class FmuTarget:
    """Target `fmu`: `model_fmi2.fmu` and `model_fmi3.fmu`."""

    name = "fmu"
    usage = """`model_fmi2.fmu` (FMI 2.0) and `model_fmi3.fmu` (FMI 3.0) are for co-simulation. The
step of the master is the sampling time; another step is refused. Set the inputs, read the outputs
of the sample, do a step. The first output is there before the first step. A master that reads the
outputs of a sample before it sets its inputs sees a direct effect of the input one step late. The
parameters `past_u[k,i]` and `past_y[k,j]` (k = 1 the oldest) start the model; their start values
are those of a training window. The units hold C sources, and a binary for the platform they were
made on."""

    def missing(self) -> str | None:
        """Return a sentence if fmpy, which checks the units, or a C compiler is missing."""
        if not is_installed("fmpy"):
            return "pip install '.[export]' in a clone of ASIA"
        return None if c_compiler() else "install a C compiler, such as gcc"

    def print(self, model: ExportModel) -> Printed:
        """Print both units."""
        return Printed({f"model_fmi{v}.fmu": _unit(model, v) for v in (2, 3)})

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Validate the units and simulate them with fmpy."""
        from fmpy import extract, read_model_description
        from fmpy.validation import validate_fmu

        found: list[Answers] = []
        for version in (2, 3):
            path = folder / f"model_fmi{version}.fmu"
            problems = validate_fmu(str(path))
            if problems:
                raise InternalError(f"the printed FMU is not valid: {problems[0]}")
            described: Any = read_model_description(str(path))
            with tempfile.TemporaryDirectory(prefix="asia-fmu-") as made:
                extract(str(path), unzipdir=made)
                begin = time.perf_counter()
                y_hat = tuple(_simulated(described, made, version, w) for w in windows)
                seconds = time.perf_counter() - begin
            found.append(Answers(f"FMI {version}.0", y_hat, seconds))
        return found


def _simulated(described: Any, folder: str, version: int, window: SimulatedSegment) -> Array:
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    kind: Any = FMU2Slave if version == 2 else FMU3Slave
    unit = kind(
        guid=described.guid,
        unzipDirectory=folder,
        modelIdentifier="asia_model",
        instanceName="unit",
    )
    step = float(described.defaultExperiment.stepSize)
    unit.instantiate()
    nu, ny = window.u.shape[1], window.y_hat.shape[1]
    past = [*window.past_u.reshape(-1).tolist(), *window.past_y.reshape(-1).tolist()]
    places = list(range(1 + nu + ny, 1 + nu + ny + len(past)))
    inputs, outputs = list(range(1, 1 + nu)), list(range(1 + nu, 1 + nu + ny))
    put, get = (unit.setReal, unit.getReal) if version == 2 else (unit.setFloat64, unit.getFloat64)
    if version == 2:
        unit.setupExperiment(startTime=0.0)
        unit.enterInitializationMode()
    else:
        unit.enterInitializationMode(startTime=0.0)
    if past:
        put(places, past)
    unit.exitInitializationMode()
    rows: list[list[float]] = []
    for k, u in enumerate(window.u.tolist()):
        put(inputs, u)
        rows.append(get(outputs))
        unit.doStep(currentCommunicationPoint=k * step, communicationStepSize=step)
    unit.terminate()
    unit.freeInstance()
    return np.array(rows)


def _unit(model: ExportModel, version: int) -> bytes:
    source, _ = c_source(model)
    token = str(uuid.uuid5(uuid.NAMESPACE_OID, source))
    files = {
        "model.c": source,
        "model.h": header(model),
        "fmi.c": shell([v[3] or 0.0 for v in variables(model)], version, token),
    }
    system, ending = ("darwin", ".dylib") if sys.platform == "darwin" else ("linux", ".so")
    arm = platform.machine().lower() in ("arm64", "aarch64")
    place = f"{system}64" if version == 2 else f"{'aarch64' if arm else 'x86_64'}-{system}"
    compiler = c_compiler()
    assert compiler is not None
    with tempfile.TemporaryDirectory(prefix="asia-fmu-") as made:
        for name, text in files.items():
            (Path(made) / name).write_text(text)
        words = ["-std=c99", "-O2", "-fPIC", "-shared", "model.c", "fmi.c", "-o", "unit.so", "-lm"]
        compile_c(compiler, words, Path(made), "FMU")
        binary = (Path(made) / "unit.so").read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:

        def put(name: str, data: bytes) -> None:
            # A constant date: the same model gives the same bytes.
            entry = zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)

        put("modelDescription.xml", _description(model, version, token).encode())
        for name, text in files.items():
            put(f"sources/{name}", text.encode())
        if version == 3:
            put("sources/buildDescription.xml", template("buildDescription.xml").encode())
        put(f"binaries/{place}/asia_model{ending}", binary)
    return packed.getvalue()


def variables(model: ExportModel) -> list[tuple[str, str, str, float | None]]:
    """Name, causality, unit and start value of each variable, in the order of the references, which
    count from 1."""
    low, window = model.lowered, model.example
    past_u = np.zeros((low.n_past_u, low.nu)) if window is None else window.past_u
    past_y = np.zeros((low.n_past_y, low.ny)) if window is None else window.past_y
    first = np.zeros(low.nu) if window is None else window.u[0]
    rows: list[tuple[str, str, str, float | None]] = []
    for signal, value in zip(model.inputs, first.tolist(), strict=True):
        rows.append((signal.name, "input", signal.unit, value))
    rows += [(s.name, "output", s.unit, None) for s in model.outputs]
    for name, past, signals in (
        ("past_u", past_u, model.inputs),
        ("past_y", past_y, model.outputs),
    ):
        for k, row in enumerate(past.tolist(), 1):
            for i, value in enumerate(row, 1):
                rows.append((f"{name}[{k},{i}]", "parameter", signals[i - 1].unit, value))
    names = [r[0] for r in rows]
    return [(f"{n} {c}" if names.count(n) > 1 else n, c, unit, start) for n, c, unit, start in rows]


def _description(model: ExportModel, version: int, token: str) -> str:
    rows = variables(model)
    outputs = range(1 + len(model.inputs), 1 + len(model.inputs) + len(model.outputs))
    step = repr(model.sampling_time)
    title = quoteattr(f"{model.use} of run {model.name}")
    names = f'modelName={quoteattr(model.problem)} description={title} generationTool="ASIA"'
    listed = ""
    for reference, (name, causality, unit, start) in enumerate(rows, 1):
        varies = "fixed" if causality == "parameter" else "continuous"
        value = "" if start is None else f' start="{start!r}"'
        attributes = (
            f'name={quoteattr(name)} valueReference="{reference}" causality="{causality}" '
            f'variability="{varies}" description={quoteattr(unit)}'
        )
        if version == 3:
            listed += f"\n<Float64 {attributes}{value}/>"
        else:
            listed += f"\n<ScalarVariable {attributes}><Real{value}/></ScalarVariable>"
    experiment = f'<DefaultExperiment startTime="0.0" stepSize="{step}"/>'
    if version == 2:
        ends = "".join(f'<Unknown index="{i}"/>' for i in outputs)
        return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" guid="{token}" {names} variableNamingConvention="flat">
<CoSimulation modelIdentifier="asia_model" canHandleVariableCommunicationStepSize="false">
<SourceFiles><File name="model.c"/><File name="fmi.c"/></SourceFiles>
</CoSimulation>
{experiment}
<ModelVariables>{listed}
</ModelVariables>
<ModelStructure><Outputs>{ends}</Outputs><InitialUnknowns>{ends}</InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""
    ends = "".join(f'<Output valueReference="{i}"/>' for i in outputs)
    starts = "".join(f'<InitialUnknown valueReference="{i}"/>' for i in outputs)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" instantiationToken="{token}" {names}>
<CoSimulation modelIdentifier="asia_model" canHandleVariableCommunicationStepSize="false" \
fixedInternalStepSize="{step}"/>
{experiment}
<ModelVariables>
<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>{listed}
</ModelVariables>
<ModelStructure>{ends}{starts}</ModelStructure>
</fmiModelDescription>
"""
