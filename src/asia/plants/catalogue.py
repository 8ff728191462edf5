"""Entries of the catalogue: their schema, the loader, and equations in the names of a problem."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import MinLen
from pydantic import ConfigDict, with_config

from asia._text import nearest
from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.problem.physics import (
    Bounds,
    ParameterRange,
    Physics,
    Prior,
    check_physics,
    parse_expression,
)
from asia.problem.toml import read_table

_FOLDER = Path(__file__).resolve().parent
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "sqrt": math.sqrt, "abs": abs, "min": min, "max": max, "exp": math.exp,
}  # fmt: skip
_EXAMPLE_STEP = 1.0

Effect = Literal[
    "saturation", "spill", "offset", "input_delay", "sensor", "lag", "smooth", "friction",
    "presliding", "hysteresis", "play", "discover", "noise_model",
]  # fmt: skip
"""Effects that a plant usually has: settings of the grey-box that add them."""
Sign = Literal["integrates", "resonates", "transport", "limit"]
"""Findings in the records that point at a plant: an output integrates, an output has a lightly
damped mode, the delay varies with an input, an output rests at a limit."""


@dataclass(frozen=True, kw_only=True)
class Range:
    """Search range of a parameter, relative to the records."""

    min: float
    max: float
    unit: str = "1"
    """Expression by which the range is multiplied: roles are the deviations of their signals, `dt`
    is the sampling time."""
    around: str = "0"
    """Expression that is added: roles are the means of their signals."""
    example: float | None = None
    """Value in the range, in `unit` and from `around`, for examples; None is its middle."""


@dataclass(frozen=True, kw_only=True)
class Role:
    """A signal of the plant, by which a signal of a problem is recognised."""

    words: Annotated[tuple[str, ...], MinLen(1)]
    quantity: str
    """Quantity that it measures, a key of `quantities.toml`."""
    example: tuple[float, float] = (0.0, 1.0)
    """Mean and deviation in examples."""
    absent: Range | None = None
    """Range of the constant that takes the place of an input without a signal; None for an input
    that must have one."""
    optional: bool = False
    """Whether an output may have no signal."""


@dataclass(frozen=True, kw_only=True)
class PlantEquations:
    """Equations in the language of `[physics]`, in the names of the roles."""

    states: Annotated[tuple[str, ...], MinLen(1)]
    dynamics: Mapping[str, str]
    parameters: Mapping[str, Range]
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    definitions: Mapping[str, str] = field(default_factory=dict[str, str])
    observation: Mapping[str, str] = field(default_factory=dict[str, str])
    bounds: Mapping[str, Bounds] = field(default_factory=dict[str, Bounds])
    priors: Mapping[str, Prior] = field(default_factory=dict[str, Prior])


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Entry:
    """File of a plant."""

    title: str
    words: Annotated[tuple[str, ...], MinLen(1)]
    """Words of the plant beside those of its signals."""
    inputs: Annotated[Mapping[str, Role], MinLen(1)]
    outputs: Annotated[Mapping[str, Role], MinLen(1)]
    physics: PlantEquations
    unknown: str
    """Parameters that no record determines, and the prior that helps."""
    source: str
    """Textbook and chapter."""
    effects: tuple[Effect, ...] = ()
    signs: tuple[Sign, ...] = ()
    start: Mapping[str, float] = field(default_factory=dict[str, float])
    """Initial states of examples; 0 is the default."""


@dataclass(frozen=True)
class Plant:
    """A plant of the catalogue."""

    name: str
    """Name of its file."""
    entry: Entry

    @property
    def title(self) -> str:
        """Title in words."""
        return self.entry.title

    def physics(
        self,
        signals: Mapping[str, str],
        inputs: Sequence[Signal],
        outputs: Sequence[Signal],
        records: Sequence[Trajectory],
    ) -> Physics:
        """Write the equations in the names of a problem, with ranges from its records.

        Args:
            signals: name of the signal of each role.
            inputs, outputs: signals of the problem.
            records: training records.

        Raises:
            UserError: for a role without its signal, and a signal that no equation can name.
        """
        u = np.concatenate([r.u for r in records])
        y = np.concatenate([r.y for r in records])
        names = [s.name for s in (*inputs, *outputs)]
        columns = dict(zip(names, np.column_stack([u, y]).T, strict=True))
        sizes: dict[str, tuple[float, float]] = {}
        for role, name in signals.items():
            if name not in columns:
                raise UserError(f"{self.name}: no signal is called '{name}'{nearest(name, names)}")
            values = columns[name]
            sizes[role] = float(np.nanmean(values)), float(np.nanstd(values)) or 1.0
        seen = [s.name for s in inputs]
        step = records[0].sampling_time
        physics = _written(self, signals, sizes, step, taken=seen)
        check_physics(physics, seen, [s.name for s in outputs])
        return physics

    def example(self) -> Physics:
        """The equations in the names of the roles, at the sizes of the examples."""
        roles = {**self.entry.inputs, **self.entry.outputs}
        sizes = {name: role.example for name, role in roles.items()}
        signals = {name: name for name in roles}
        return _written(self, signals, sizes, _EXAMPLE_STEP, taken=list(self.entry.inputs))

    def example_parameters(self) -> dict[str, float]:
        """Values of the parameters in the example."""
        ranges, physics = self.entry.physics.parameters, self.example()
        found: dict[str, float] = {}
        for name, known in physics.parameters.items():
            given = ranges[name]
            low, high = known.min, known.max
            if given.example is not None:
                share = (given.example - given.min) / (given.max - given.min)
                found[name] = low + share * (high - low)
            else:
                found[name] = math.sqrt(low * high) if low > 0 else (low + high) / 2
        return found


def _written(
    plant: Plant,
    signals: Mapping[str, str],
    sizes: Mapping[str, tuple[float, float]],
    step: float,
    taken: Sequence[str],
) -> Physics:
    entry, equations = plant.entry, plant.entry.physics
    for name, role in {**entry.inputs, **entry.outputs}.items():
        if name not in signals and role.absent is None and not role.optional:
            raise UserError(f"{plant.name}: no signal is given for its {name}")
    used = {name: signals[name] for name in entry.inputs if name in signals}
    for role, name in used.items():
        if not name.isidentifier():
            raise UserError(
                f"{plant.name}: '{name}', its {role}, cannot be written in an equation; rename the "
                "column with letters, digits and underscores"
            )
    free = {n: r.absent for n, r in entry.inputs.items() if n not in signals and r.absent}
    own = (
        *equations.states, *equations.parameters, *free, *equations.constants,
        *equations.definitions,
    )  # fmt: skip
    # Names of the plant's own that the problem has given to a signal get an underscore.
    names = {n: n for n in own}
    for name in own:
        while names[name] in taken:
            names[name] += "_"
    names |= used

    def text(expression: str) -> str:
        return re.sub(r"[A-Za-z_]\w*", lambda m: names.get(m[0], m[0]), expression)

    mean = {role: size[0] for role, size in sizes.items()} | {"dt": step}
    deviation = {role: size[1] for role, size in sizes.items()} | {"dt": step}

    def scaled(name: str, given: Range) -> ParameterRange:
        unit, around = (
            parse_expression(expression, f"{plant.name}: {name}").evaluate(values, _FUNCTIONS)
            for expression, values in ((given.unit, deviation), (given.around, mean))
        )
        return ParameterRange(*(_rounded(around + unit * end) for end in (given.min, given.max)))

    return Physics(
        states=tuple(names[n] for n in equations.states),
        parameters={names[n]: scaled(n, r) for n, r in {**equations.parameters, **free}.items()},
        constants={names[n]: value for n, value in equations.constants.items()},
        definitions={names.get(n, n): text(e) for n, e in equations.definitions.items()},
        dynamics={names.get(n, n): text(e) for n, e in equations.dynamics.items()},
        observation={
            signals[n]: text(equations.observation.get(n, n))
            for n in entry.outputs
            if n in signals and equations.observation.get(n, n) != signals[n]
        },
        bounds={names.get(n, n): b for n, b in equations.bounds.items()},
        priors={text(e): p for e, p in equations.priors.items()},
    )


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


@cache
def catalogue() -> Mapping[str, Plant]:
    """All plants by name.

    Raises:
        UserError: for an entry that is not right, in a sentence
    """
    paths = sorted((_FOLDER / "entries").glob("*.toml"))
    return {path.stem: load_plant(path) for path in paths}


@cache
def quantities() -> Mapping[str, tuple[str, ...]]:
    """Units of each quantity."""
    found: Any = read_table(_FOLDER / "quantities.toml", _Quantities)
    return found.units


@with_config(_STRICT)
@dataclass(frozen=True)
class _Quantities:
    units: Mapping[str, tuple[str, ...]]


def load_plant(path: Path) -> Plant:
    """Read an entry.

    Raises:
        UserError: for an unknown key, an undefined symbol, a quantity or a unit that is not known
    """
    plant = Plant(path.stem, read_table(path, Entry))
    entry = plant.entry
    known = {"dt", *(n for n, r in entry.inputs.items() if r.absent is None)}
    known |= {n for n, r in entry.outputs.items() if not r.optional}
    for name, role in {**entry.inputs, **entry.outputs}.items():
        if role.quantity not in quantities():
            raise UserError(
                f"{path.name}: {name} has the quantity '{role.quantity}'"
                f"{nearest(role.quantity, quantities())}, known are {', '.join(quantities())}"
            )
    absent = {n: r.absent for n, r in entry.inputs.items() if r.absent}
    for name, given in {**entry.physics.parameters, **absent}.items():
        for text in (given.unit, given.around):
            expression = parse_expression(text, f"{path.name}: {name}")
            if strange := sorted(expression.names - known):
                raise UserError(
                    f"{path.name}: the range of {name} names '{strange[0]}', which may have no "
                    "signal; name a role that always has one, or dt"
                )
    try:
        check_physics(plant.example(), list(entry.inputs), list(entry.outputs))
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from error
    return plant


def plant_named(name: str) -> Plant:
    """A plant by name. Raises UserError for one that is not in the catalogue."""
    known = catalogue()
    if name not in known:
        raise UserError(
            f"no plant is called '{name}'{nearest(name, known)}; the catalogue has "
            f"{', '.join(known)}"
        )
    return known[name]
