"""Parameter estimates of a fitted model as bytes of a fixed layout.

Both ends of a worker's pipes use it. The reading end parses numbers, names of a few characters and
lines of printable text, and nothing else. Estimates are a head, one row per parameter, the
correlations, and as text the reason why there are no standard errors, then the equations.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from asia.candidate import ParameterEstimates

PARAMETERS = 64
"""The most named parameters of a fitted model that are kept."""
_PARAMETER = struct.Struct("<48sd")
PARAMETERS_BYTES = PARAMETERS * _PARAMETER.size
_NO_NAME = re.compile(r"[^A-Za-z0-9 _.,/\[\]-]")
_NO_UNIT = re.compile(r"[^A-Za-z0-9 _.,/\[\]*^%()+-]")
_NO_TEXT = re.compile(r"[^\x20-\x7e\n]")

_HEAD = struct.Struct("<Q")
_ESTIMATE = struct.Struct("<48s16s8d")
_NUMBER = struct.Struct("<d")
_TEXT_BYTES, _REASON = 8000, 400
ESTIMATES_BYTES = (
    _HEAD.size + PARAMETERS * (_ESTIMATE.size + PARAMETERS * _NUMBER.size) + _TEXT_BYTES
)


def pack_parameters(offered: object) -> bytes:
    """Pack parameters into rows of one length, each a name and a float64; values that are not
    finite are left out. Raises Exception where `offered` is no mapping of names to numbers."""
    if not isinstance(offered, Mapping):
        raise TypeError("parameters: expected a mapping of names to numbers")
    rows = [(_raw(name, 48), float(v)) for name, v in offered.items()]
    finite = [row for row in rows if math.isfinite(row[1])]
    return b"".join(_PARAMETER.pack(*row) for row in finite[:PARAMETERS])


def unpack_parameters(body: bytes) -> tuple[tuple[str, float], ...]:
    """The names, of letters, digits and a few marks, each once, with their numbers. Raises
    ValueError where `body` has another size than rows have, or a number is not finite."""
    if len(body) % _PARAMETER.size or len(body) > PARAMETERS_BYTES:
        raise ValueError(f"{len(body)} bytes of parameters")
    found: dict[str, float] = {}
    for raw, value in _PARAMETER.iter_unpack(body):
        if not math.isfinite(value):
            raise ValueError("a parameter that is not finite")
        found.setdefault(_name(raw), value)
    return tuple(found.items())


def count_numbers(value: Any, seen: dict[int, Any]) -> int:
    """Count the floating-point numbers in a fitted model, each object once.

    Args:
        value: the model, or a part of it. A part with a number `n_parameters` counts as that.
        seen: objects that were counted, by their id
    """
    if isinstance(value, float | complex):
        return 1
    if value is None or isinstance(value, int | str | bytes | type) or id(value) in seen:
        return 0
    seen[id(value)] = value
    if isinstance(known := getattr(value, "n_parameters", None), int):
        return known
    if hasattr(value, "dtype") and hasattr(value, "size"):
        return int(value.size) if getattr(value.dtype, "kind", "") in ("f", "c") else 0
    if isinstance(value, Mapping):
        parts: list[Any] = list(value.values())
    elif isinstance(value, list | tuple | set | frozenset):
        parts = list(value)
    else:
        names = {name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())}
        parts = [getattr(value, name, None) for name in {*getattr(value, "__dict__", ()), *names}]
        parts = [one for one in parts if not callable(one) or hasattr(one, "__dataclass_fields__")]
    return sum(count_numbers(one, seen) for one in parts)


def pack_estimates(offered: Any) -> bytes:
    """Those of an `asia.candidate.ParameterEstimates`. Raises where it is none."""
    rows: Sequence[Any] = list(offered.parameters)[:PARAMETERS]
    body = [_HEAD.pack(len(rows))]
    for one in rows:
        figures = (
            one.value, one.standard_error, one.low, one.high, one.lower, one.upper, one.data_share,
            one.misfit_error,
        )  # fmt: skip
        body.append(_ESTIMATE.pack(_raw(one.name, 48), _raw(one.unit, 16), *map(float, figures)))
    for i in range(len(rows)):
        body += [_NUMBER.pack(float(offered.correlation[i][j])) for j in range(len(rows))]
    lines = (str(offered.reason)[:_REASON], *map(str, offered.equations))
    text = "\n".join(line.replace("\n", " ") for line in lines)
    body.append(text.encode("ascii", "replace")[:_TEXT_BYTES])
    return b"".join(body)


def pack_values(model: Any, reason: str) -> bytes:
    """Pack the parameters and equations that a model names, without standard errors, and the reason
    why there are none. Raises where it names no parameters."""
    import numpy as np

    from asia.candidate import ParameterEstimate, ParameterEstimates

    values = [(name, float(value)) for name, value in model.parameters().items()]
    rows = [
        ParameterEstimate(name, value, math.nan, math.nan, math.nan)
        for name, value in values
        if math.isfinite(value)
    ]
    equations = getattr(model, "equations", tuple)()
    unknown = np.full((len(rows), len(rows)), math.nan)
    return pack_estimates(ParameterEstimates(tuple(rows), unknown, tuple(equations), reason))


def unpack_estimates(body: bytes) -> ParameterEstimates:
    """Unpack the result of `pack_estimates`. Raises ValueError where `body` cannot be a result of
    `pack_estimates`."""
    # Here, as the worker reads nothing: it imports this module without these.
    import numpy as np

    from asia.candidate import ParameterEstimate, ParameterEstimates

    if not _HEAD.size <= len(body) <= ESTIMATES_BYTES:
        raise ValueError(f"{len(body)} bytes of estimates")
    (count,) = _HEAD.unpack_from(body)
    table = _HEAD.size + count * _ESTIMATE.size
    text = table + count * count * _NUMBER.size
    if count > PARAMETERS or text > len(body) or len(body) - text > _TEXT_BYTES:
        raise ValueError(f"{len(body)} bytes of {count} estimates")
    rows: dict[str, ParameterEstimate] = {}
    for raw, raw_unit, value, error, low, high, *others in _ESTIMATE.iter_unpack(
        body[_HEAD.size : table]
    ):
        if not math.isfinite(value):
            raise ValueError("a parameter that is not finite")
        name, unit = _name(raw), _NO_UNIT.sub("_", _plain(raw_unit))
        rows[name] = ParameterEstimate(name, value, error, low, high, unit, *others)
    if len(rows) != count:
        raise ValueError("a parameter that is named twice")
    correlation = np.frombuffer(body[table:text], "<f8").astype(np.float64).reshape(count, count)
    words = _NO_TEXT.sub("_", body[text:].decode("ascii", "replace"))
    reason, *equations = words.split("\n")
    return ParameterEstimates(tuple(rows.values()), correlation, tuple(equations), reason)


def _raw(word: object, size: int) -> bytes:
    return str(word).encode("ascii", "replace")[:size]


def _plain(raw: bytes) -> str:
    return raw.rstrip(b"\0").decode("ascii", "replace")


def _name(raw: bytes) -> str:
    return _NO_NAME.sub("_", _plain(raw)) or "_"
