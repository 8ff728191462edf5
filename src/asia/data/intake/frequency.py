"""Measured frequency responses: text, spreadsheets, NumPy and MATLAB files."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asia.data.frequency import FrequencyRecord
from asia.data.intake.formats import file_format
from asia.data.intake.sheet import FileTable, Wanted, split_unit
from asia.data.intake.text import to_numbers
from asia.data.trajectory import Array, Signal
from asia.errors import UserError

_FREQUENCY = ("frequency", "freq", "f", "omega", "w")
_HZ = {
    "hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9, "rad/s": 0.5 / math.pi, "rpm": 1.0 / 60.0,
    "krad/s": 500.0 / math.pi, "cycles/s": 1.0, "cycles/timeunit": 1.0,
    "rad/timeunit": 0.5 / math.pi, "rad/sec": 0.5 / math.pi, "rad/second": 0.5 / math.pi,
}  # fmt: skip
_PARTS = {
    "real": "real", "re": "real", "imag": "imag", "im": "imag", "imaginary": "imag",
    "magnitude": "size", "mag": "size", "gain": "size", "amplitude": "size", "phase": "phase",
    "std": "std", "deviation": "std", "variance": "variance", "var": "variance",
}  # fmt: skip
_LEVEL = re.compile(r"^(?P<name>.+?)[ _](?P<unit>dB|db|DB|deg|rad)$")
_COLUMN = re.compile(r"^(?:(?P<pair>.*?)[ _.])??(?P<part>[A-Za-z]+)$")
_SAVE = (
    "s = struct('ResponseData', g.ResponseData, 'Frequency', g.Frequency, 'FrequencyUnit', "
    "g.FrequencyUnit, 'Ts', g.Ts); save('response.mat', '-struct', 's', '-v7')"
)


def read_frequency_response(path: Path) -> FrequencyRecord:
    """Read a measured frequency response.

    A table has a column `frequency` (or `f` in Hz, `omega` or `w` in rad/s; a unit in brackets
    counts), and `real` and `imag`, or `magnitude` and `phase`; with several responses the names are
    `OUTPUT/INPUT real`. Optional: `std` or `variance`. NumPy and MATLAB files have `frequency` and
    `response` (F, ny, nu), or the fields of a MATLAB frd or idfrd: `Frequency`, `ResponseData` (ny,
    nu, F), `FrequencyUnit`, `Ts`, `CovarianceData`. Raises UserError for a file without a frequency
    response.
    """
    suffix = path.suffix.casefold()
    if suffix == ".mat":
        found = _of_tree(path, _matlab(path))
    elif suffix == ".npz":
        try:
            found = _of_tree(path, dict(np.load(path, allow_pickle=False).items()))
        except (OSError, ValueError) as error:
            raise UserError(f"{path} does not read as a NumPy file: {error}") from None
    else:
        (table, *_) = file_format(path).read(path, Wanted((), ()))
        found = _of_table(path, table)
    order = np.argsort(found.frequency, kind="stable")
    frequency, response = found.frequency[order], found.response[order]
    variance = None if found.variance is None else found.variance[order]
    good = np.isfinite(frequency) & np.isfinite(response).all(axis=(1, 2)) & (frequency >= 0)
    if variance is not None:
        good &= (variance > 0).all(axis=(1, 2))
    if found.sampling_time:
        good &= frequency <= 0.5 / found.sampling_time * (1.0 + 1e-9)
    if good.sum() < 8:
        raise UserError(
            f"{path} has {int(good.sum())} usable frequencies, expected at least 8 with a finite "
            "response"
        )
    return FrequencyRecord(
        found.name, frequency[good], response[good],
        None if variance is None else variance[good],
        found.sampling_time, found.inputs, found.outputs,
    )  # fmt: skip


def write_response(path: Path, record: FrequencyRecord) -> None:
    """Write a frequency response as a NumPy file, which reads back the same."""
    known: dict[str, Any] = {} if record.variance is None else {"variance": record.variance}
    np.savez(
        path, frequency=record.frequency, response=record.response,
        sampling_time=record.sampling_time, inputname=[s.name for s in record.inputs],
        outputname=[s.name for s in record.outputs], **known,
    )  # fmt: skip


def _of_table(path: Path, table: FileTable) -> FrequencyRecord:
    frequency: Array | None = None
    pairs: dict[str, dict[str, Array]] = {}
    for label, column in table.columns.items():
        name, unit = split_unit(label)
        ended = _LEVEL.match(name)
        name, unit = (ended["name"], ended["unit"]) if ended and not unit else (name, unit)
        unit = (column.unit or unit).casefold()
        match = _COLUMN.match(name)
        if name.casefold() in _FREQUENCY:
            default = "rad/s" if name.casefold() in ("omega", "w") else "hz"
            values = to_numbers(column.cells, f"{path}, column '{label}'", table.first_line)
            frequency = values * _to_hz(unit or default, path)
        elif match is not None and match["part"].casefold() in _PARTS:
            part = _PARTS[match["part"].casefold()]
            values = to_numbers(column.cells, f"{path}, column '{label}'", table.first_line)
            # A magnitude is not negative, a level in dB may be.
            if part == "size" and (unit == "db" or (values < 0).any()):
                if unit not in ("", "db"):
                    raise UserError(
                        f"{path}, column '{label}': a magnitude is negative: give it in dB, as "
                        f"{name} [dB], or correct it"
                    )
                values = 10.0 ** (values / 20.0)
            if part == "phase":
                values = values if _in_radians(values, unit, path, label) else np.radians(values)
            pairs.setdefault(match["pair"] or "", {})[part] = values
    if frequency is None or not pairs:
        raise UserError(
            f"{path} has no frequency response (columns {', '.join(table.columns)}): expected "
            "frequency, real and imag, or frequency, magnitude and phase"
        )
    ends = [_ends(pair, len(pairs)) for pair in pairs]
    outputs = list(dict.fromkeys(out for out, _ in ends))
    inputs = list(dict.fromkeys(into for _, into in ends))
    response = np.full((len(frequency), len(outputs), len(inputs)), np.nan + 0j)
    variance = np.full(response.shape, np.nan)
    for (out, into), (pair, parts) in zip(ends, pairs.items(), strict=True):
        place = slice(None), outputs.index(out), inputs.index(into)
        if {"real", "imag"} <= parts.keys():
            response[place] = parts["real"] + 1j * parts["imag"]
        elif {"size", "phase"} <= parts.keys():
            response[place] = parts["size"] * np.exp(1j * parts["phase"])
        else:
            raise UserError(
                f"{path}: response '{pair or 'of the file'}' has {', '.join(parts)}, expected real "
                "and imag, or magnitude and phase"
            )
        if "std" in parts or "variance" in parts:
            variance[place] = parts.get("variance", parts.get("std", np.zeros(1)) ** 2)
    missing = np.isnan(response).all(axis=0)
    if missing.any():
        i, j = np.argwhere(missing)[0]
        raise UserError(f"{path}: the response of {outputs[i]} by {inputs[j]} is missing")
    known = None if np.isnan(variance).any() else variance
    return FrequencyRecord(
        path.stem, frequency, response, known, 0.0,
        tuple(Signal(n) for n in inputs), tuple(Signal(n) for n in outputs),
    )  # fmt: skip


def _in_radians(phase: Array, unit: str, path: Path, label: str) -> bool:
    """Return whether a phase is in radians. Raises UserError where its unit is not known."""
    if unit in ("rad", "radians"):
        return True
    span = float(np.nanmax(np.abs(phase), initial=0.0))
    if unit or span == 0 or span > 2.0 * math.pi:
        return False
    raise UserError(
        f"{path}, column '{label}': a phase of at most {span:.3g} may be in degrees or in radians: "
        "write phase [deg] or phase [rad]"
    )


def _ends(pair: str, count: int) -> tuple[str, str]:
    """Output and input of `OUTPUT/INPUT` or `OUTPUT by INPUT`."""
    out, slash, into = pair.replace(" by ", "/").partition("/")
    if slash:
        return out.strip(), into.strip()
    return (pair or "y", "u") if count > 1 or pair else ("y", "u")


def _to_hz(unit: str, path: Path) -> float:
    if unit.casefold() not in _HZ:
        raise UserError(f"{path}: unit '{unit}' of the frequency, expected {', '.join(_HZ)}")
    return _HZ[unit.casefold()]


def _matlab(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        found: dict[str, Any] = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise UserError(f"{path} is a MAT file of version 7.3: save it again with '-v7'") from None
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path} does not read as a MAT file: {error}") from None
    return {k: v for k, v in found.items() if not k.startswith("__")}


def _of_tree(path: Path, tree: Mapping[str, Any]) -> FrequencyRecord:
    """Fields of an frd or idfrd, or `frequency` and `response`, on any level of the tree."""
    nodes: list[Mapping[str, Any]] = [tree]
    for node in nodes:
        named = {key.casefold(): value for key, value in node.items()}
        if "frequency" in named and named.keys() & {"responsedata", "response"}:
            break
        nodes += [value for value in node.values() if isinstance(value, Mapping)]
    else:
        raise UserError(
            f"{path} has no frequency response: expected Frequency and ResponseData, or frequency "
            f"and response. Of an frd or idfrd object g save a structure: {_SAVE}"
        )
    frequency = np.asarray(named["frequency"], np.float64).reshape(-1)
    of_matlab = "responsedata" in named
    response = np.asarray(named["responsedata" if of_matlab else "response"], np.complex128)
    count = len(frequency)
    if response.size == count:
        response = response.reshape(count, 1, 1)
    elif of_matlab and response.ndim >= 2 and response.shape[-1] == count:
        # simplify_cells drops sides of length 1.
        ny = _count(named.get("outputname"), response.shape[0] if response.ndim == 3 else None)
        response = response.reshape(ny or response.shape[0], -1, count).transpose(2, 0, 1)
    if response.ndim != 3 or len(response) != count:
        raise UserError(
            f"{path}: {count} frequencies, but a response of shape {response.shape}: expected "
            f"{'(ny, nu, F)' if of_matlab else '(F, ny, nu)'}"
        )
    default = "rad/s" if of_matlab else "hz"
    unit = str(named.get("frequencyunit", named.get("unit", default)))
    step = float(np.asarray(named.get("ts", named.get("sampling_time", 0.0))).reshape(-1)[0])
    ny, nu = response.shape[1:]
    return FrequencyRecord(
        path.stem, frequency * _to_hz(unit, path), response,
        _variance(named.get("covariancedata", named.get("variance")), (count, ny, nu)),
        max(step, 0.0), _signals(named.get("inputname"), nu, "u"),
        _signals(named.get("outputname"), ny, "y"),
    )  # fmt: skip


def _count(names: Any, known: int | None) -> int | None:
    return len(np.atleast_1d(names)) if names is not None and np.size(names) else known


def _signals(names: Any, count: int, letter: str) -> tuple[Signal, ...]:
    given = [str(n) for n in np.atleast_1d(names)] if names is not None else []
    if len(given) != count or not all(given):
        given = [letter if count == 1 else f"{letter}{k + 1}" for k in range(count)]
    return tuple(Signal(n) for n in given)


def _variance(values: Any, shape: tuple[int, int, int]) -> Array | None:
    """Variances (F, ny, nu): given like that, or as covariances (ny, nu, F, 2, 2) of real and
    imaginary parts."""
    array = np.asarray(values, np.float64) if values is not None else np.zeros(0)
    count, ny, nu = shape
    if array.size == 4 * count * ny * nu and array.shape[-2:] == (2, 2):
        both = array.reshape(ny, nu, count, 2, 2)
        return (both[..., 0, 0] + both[..., 1, 1]).transpose(2, 0, 1)
    return array.reshape(shape) if array.size == count * ny * nu else None
