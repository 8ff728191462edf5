"""Observer of a monitor as C99."""

import math
from collections.abc import Sequence
from pathlib import Path

from asia.control.observer import INCREASE, Observer
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array
from asia.export.model import ExportModel
from asia.export.targets.c import (
    Constants,
    Functions,
    column_names,
    header_fields,
    number,
    plain_text,
    preamble,
    run_compiled,
    template,
    value_at,
)

_TEMPLATES = Path(__file__).parent / "templates"
_OBSERVER_FUNCTIONS = (
    "static void observer_initial(double *z, const double *past_u, const double *past_y, "
    "const double *u)",
    "static void observer_output(const double *z, const double *u, double *y, double *slope)",
    "static void observer_update(const double *z, const double *u, double *after, double *slope)",
)


def observer_files(model: ExportModel, observer: Observer) -> dict[str, bytes]:
    """Print an extended Kalman filter: `observer.c`, `observer.h`, `observe.c`, `Makefile`.

    Args:
        model: names, units and ranges of the signals
    """
    low, n, constants = observer.low, observer.order, Constants()
    functions = Functions(constants)
    z, u = value_at("z", 0, (n,)), value_at("u", 0, (low.nu,))
    window = [value_at("past_u", 0, (low.n_past_u, low.nu)),
              value_at("past_y", 0, (low.n_past_y, low.ny)), u]  # fmt: skip
    parts = (
        (low.initial, window, [z]),
        (observer.output, [z, u], [value_at("y", 0, (low.ny,)), value_at("slope", 0, (low.ny, n))]),
        (observer.update, [z, u],
         [value_at("after", 0, (n,)), value_at("slope", 0, (n, n + low.nu))]),
    )  # fmt: skip
    steps = [
        functions.function(head, *part)
        for head, part in zip(_OBSERVER_FUNCTIONS, parts, strict=True)
    ]
    body = "\n".join([*functions.texts, *steps])

    def row(values: Sequence[float] | Array) -> str:
        return ", ".join(number(float(v)) for v in values)

    named = observer.parameters
    values = ["{" + row([p.nominal, p.spread, p.low, p.high, p.floor]) + "}" for p in named] or [
        "{0.0}"
    ]
    filled = template(
        _TEMPLATES / "observer.c",
        START=row(observer.start),
        DRIVE=row(observer.drive),
        INPUT_NOISE=row(observer.noise.input),
        OUTPUT_NOISE=row(observer.noise.output),
        VALUES=", ".join(values),
        FORGETTING=repr(observer.forgetting),
        THRESHOLD=repr(observer.threshold),
        DEVIATIONS=repr(observer.deviations),
        FACTOR=repr(0.5 * (1.0 - 1.0 / INCREASE)),
        LOSS=repr(0.5 * math.log(INCREASE)),
    )
    about = header_fields(model)
    source = [
        f"/* {about['TITLE']}: observer. */",
        '#include "observer.h"',
        "#include <string.h>",
        "#undef ASIA_FLOAT",
        "typedef double asia_real;",
        *preamble(body, constants),
        body,
        filled,
    ]
    names = [plain_text(p.name) for p in named]
    printed = [f"{plain_text(s.name)}_expected" for s in model.outputs] + ["nis", "statistic"]
    printed += [column for name in names for column in (name, f"{name}_deviation")] + ["since"]
    made = template(
        _TEMPLATES / "observer.h",
        **about,
        N=n,
        P=len(named),
        THRESHOLD=f"{observer.threshold:.4g}",
        PARAMETERS=", ".join(names) or "none",
    )
    columns = column_names((*model.inputs, *model.outputs))
    makefile = template("Makefile").replace("model", "observer").replace("main", "observe")
    return {
        "observer.c": "\n".join(source).encode(),
        "observer.h": made.encode(),
        "observe.c": template(
            _TEMPLATES / "observe.c", COLUMNS=columns, PRINTED=",".join(printed)
        ).encode(),
        "Makefile": makefile.encode(),
    }


def observed(
    compiler: str, folder: Path, windows: Sequence[SimulatedSegment], width: int
) -> tuple[list[Array], float]:
    """Compile the files of `observer_files` and run them on windows: results (H, width) as
    `observer_harness.c` writes them, and the seconds of all."""
    calls = [((w.past_u, w.past_y, w.u, w.y), (len(w.u), width)) for w in windows]
    return run_compiled(
        compiler, folder / "observer.c", _TEMPLATES / "observer_harness.c", "asia_observe", calls
    )
