"""Results of a trained grey-box: parameters with their uncertainty, equations as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data.trajectory import INTERSAMPLE, Array
from asia.models import uncertainty
from asia.models._equations.additions import substituted
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.fit import FittedEquations
from asia.models._equations.simulate import Effects, Scales
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import RecordSegments, Starts
from asia.models._least_squares import TRIALS
from asia.models._noise.model import ErrorWeighting
from asia.problem.physics import Binary, Call, Expression, Name, Negative, Node, Number

# Estimates of the parameters of a trained grey-box, with their uncertainty.


@dataclass(frozen=True)
class Around:
    """Trained grey-box with the records that it was fitted to."""

    structure: GreyBoxStructure  # Structure of the fit
    fitted: FittedEquations  # Result of the fit
    segments: RecordSegments  # Records as the fit cut them
    values: Callable[[Array], dict[str, float]]  # Named parameters at coordinates (size,)

    def estimates(self, equations: Sequence[str]) -> ParameterEstimates:
        """Estimate the uncertainty of the parameters; `equations` are the lines with the numbers
        put in.

        Raises:
            ValueError: if these are not the records of the fit, or the measured stretches are too
                short, see `uncertainty.sandwich`.
        """
        # Import of JAX, which a trained model does not need.
        from asia.models._equations.programs import CompiledSimulator

        structure, segments = self.structure, self.segments
        if self.fitted.x0 is None or self.fitted.x0.shape != (len(segments.u), structure.nx):
            raise ValueError(
                "grey-box: estimates need the records that the model was fitted to, as many as then"
            )
        fitted, x0, whiten = self.fitted, self.fitted.x0, None
        if fitted.noise is not None:
            time, mask = structure.sampling_time, segments.noisy
            whiten = ErrorWeighting.of(fitted.noise, time, mask, fitted.huber)
        error = SimulationError(
            structure,
            segments,
            Starts(fitted.z[None], np.zeros((1, *x0.shape)), x0[None], fitted.scales.for_rows()),
            np.ones(structure.layout.size),
            CompiledSimulator(structure, segments.u, TRIALS),
            whiten,
        )
        theta = error.theta0
        e, jacobian, nuisance = error.jacobians(theta)
        # A segment ends at its last measured sample; padding follows.
        lengths = [int(np.flatnonzero(mask > 0)[-1]) + 1 for mask in segments.mask]
        residuals, jacobians, own, masks = (
            [part[:length] for part, length in zip(values, lengths, strict=True)]
            for values in (e, jacobian, nuisance, segments.counts)
        )
        held, known, weight = error.penalties(theta)
        covariance = uncertainty.sandwich(
            residuals,
            jacobians,
            held,
            own if nuisance.shape[-1] else None,
            uncertainty.PriorPenalty(known, weight),
            masks,
        )
        ranges = dict(zip(structure.equations.parameters, structure.ranges, strict=False))
        learned = zip(structure.learned.names, structure.learned.positive, strict=True)
        above = {name for name, positive in learned if positive}

        def report(z: Array) -> list[ParameterEstimate]:
            found: list[ParameterEstimate] = []
            for name, value in self.values(z).items():
                one = ParameterEstimate(name, value, math.nan, math.nan, math.nan)
                if name in ranges:
                    one = replace(one, lower=ranges[name].min, upper=ranges[name].max)
                elif name in above:
                    one = replace(one, lower=float(np.finfo(float).tiny))
                found.append(one)
            return found

        return uncertainty.estimates(covariance, report, fitted.z, equations)


# Text of the equations of a trained grey-box, with the numbers put in.

_LONGEST = 600
_STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}
_OF_MINUS, _OF_NAMES = 3, 5


def equation_lines(structure: GreyBoxStructure, scales: Scales, effect: Effects) -> list[str]:
    """Definitions, dynamics, outputs, then the limits of states and the delays of inputs; scales
    and effects are arrays without rows."""
    system = structure.equations
    values = dict(system.constants) | {
        name: float(v) for name, v in zip(system.parameters, effect.parameters, strict=True)
    }
    delayed: dict[str, Node] = {}
    for one in system.delays:
        delayed[one.name] = substituted(one.call, delayed)

    def right(e: Expression) -> str:
        return text(substituted(e.root, delayed), values)

    lines = [f"{name} = {right(e)}" for name, e in system.definitions]
    for i, (name, e) in enumerate(zip(system.states, system.dynamics, strict=True)):
        added = _added(structure, scales, effect, i) if i < structure.nx_own else ""
        lines.append(f"d({name})/dt = {right(e)}{added}")
    for i, (name, e) in enumerate(zip(system.outputs, system.observation, strict=True)):
        shown = right(e)
        offset = float(effect.output_offset[i])
        if shown != name or offset:
            lines.append(f"{name} = {shown}{signed(offset) if offset else ''}")
    for i, name in enumerate(system.states):
        low, high = structure.low[i], min(structure.high[i], float(effect.limits[i]))
        bottom = number(low) if math.isfinite(low) else ""
        if not math.isfinite(high):
            lines += [f"{name} >= {bottom}"] if bottom else []
            continue
        above = f"{bottom} <= " if bottom else ""
        lines.append(f"{above}{name} <= {number(high)}")
        share = float(effect.spill[i])
        if share and i + 1 < structure.nx_own:
            following = system.states[i + 1]
            lines.append(f"of what {name} cannot hold, {number(share)} times goes to {following}")
    if structure.config.input_delay:
        lines += [
            f"{name} acts {number(float(delay))} samples late"
            for name, delay in zip(system.inputs, effect.delay, strict=True)
        ]
    lines += [
        f"{name} is {INTERSAMPLE[kind]} between samples"
        for name, kind in zip(system.inputs, structure.between.kinds, strict=True)
        if kind != "zero"
    ]
    return [line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..." for line in lines]


def text(node: Node, values: Mapping[str, float]) -> str:
    """Text of an expression, with `values` in the place of their names."""
    return _text(node, values)[0]


def number(value: float) -> str:
    """Number with five digits."""
    return f"{value:.5g}"


def signed(value: float) -> str:
    """Number with its sign as operator: ` + 0.5` or ` - 0.5`."""
    return f" {'-' if value < 0 else '+'} {number(abs(value))}"


def _text(node: Node, values: Mapping[str, float]) -> tuple[str, int]:
    """Text of a tree, and the precedence of its operator."""
    match node:
        case Number(value):
            return number(value), _OF_NAMES if value >= 0 else _OF_MINUS
        case Name(name) if name in values:
            return _text(Number(values[name]), values)
        case Name(name):
            return name, _OF_NAMES
        case Negative(operand):
            return f"-{_inside(operand, values, _OF_MINUS)}", _OF_MINUS
        case Binary("-", Number(0.0), right):
            return f"-{_inside(right, values, _OF_MINUS)}", _OF_MINUS
        case Binary(symbol, left, right):
            strength = _STRENGTH[symbol]
            power = symbol == "**"
            first = _inside(left, values, strength + power)
            # a - (b + c), a / (b c): the right operand of a non-commutative operator keeps its
            # parentheses.
            second = _inside(right, values, strength + (symbol in "-/"))
            if power:
                return f"{first}{symbol}{second}", strength
            if symbol in "+-" and second.startswith("-"):
                symbol, second = "-" if symbol == "+" else "+", second[1:]
            return f"{first} {symbol} {second}", strength
        case Call(function, arguments):
            return f"{function}({', '.join(text(a, values) for a in arguments)})", _OF_NAMES


def _inside(node: Node, values: Mapping[str, float], least: int) -> str:
    shown, strength = _text(node, values)
    return f"({shown})" if strength < least else shown


def _added(structure: GreyBoxStructure, scales: Scales, effect: Effects, i: int) -> str:
    """Terms that are added to the derivative of a state: linear term and offset in physical units,
    the network by its size."""
    config, own = structure.config, structure.nx_own
    rate = float(scales.rate[i])
    parts, constant = "", rate * float(effect.rate_offset[i])
    if config.linear:
        names = (*structure.equations.states[:own], *structure.equations.inputs)
        center = np.concatenate([scales.x_center[:own], scales.u_center])
        scale = np.concatenate([scales.x_scale[:own], scales.u_scale])
        slopes: Array = rate * effect.linear[i] / scale
        constant -= float(slopes @ center)
        parts = "".join(
            f"{signed(float(slope))} * {name}" for slope, name in zip(slopes, names, strict=True)
        )
    if constant:
        parts += signed(constant)
    if config.residual:
        parts += f" + network of {config.residual} tanh units in states and inputs"
    return parts
