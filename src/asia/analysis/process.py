"""Process models of records: gain, one to three lags, a zero, a delay or an integrator for each
input, with 95 % intervals, and what the records cannot carry. Source of the structures: Seborg et
al., Process Dynamics and Control, chapter 7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from asia._statement import LEAST_FIT, Statement, stated
from asia.candidate import ParameterEstimate
from asia.data.process import (
    InputTransfer,
    Interval,
    OutputTransfer,
    ProcessStructure,
    fit_transfer,
)
from asia.data.statistics import staircases
from asia.data.trajectory import Intersample, Signal, Trajectory
from asia.lowering.linear import ProcessModel

__all__ = ["ProcessFit", "ProcessStructure", "fit_process"]


@dataclass(frozen=True)
class ProcessFit:
    """Process models from all inputs to one output, fitted to records."""

    models: tuple[ProcessModel | None, ...]
    """One an input, None where it is withheld; `fit` is that of the output to all inputs."""
    parameters: tuple[tuple[ParameterEstimate, ...], ...]
    """Gain, time constants, zero and delay of each input with their 95 % intervals."""
    withheld: tuple[str, ...]
    """Reason for each input that its parameters are withheld; empty where they are not."""
    first: tuple[int | None, ...]
    """Samples until the output responds to each input; None without an effect."""
    offset: float
    """Output at zero inputs; with an integrator its rate."""
    at_rest: bool
    """Whether the records begin at rest."""
    fit: float
    """100 (1 - |error| / |output - mean|), in percent."""
    between: tuple[Intersample, ...]
    """Behaviour of each input between samples."""

    def statement(self, number: int, parameter: int, unit: str = "") -> Statement:
        """Statement of a parameter of an input."""
        one = self.parameters[number][parameter]
        return _stated(one, one.unit or unit)


def fit_process(
    records: Sequence[Trajectory],
    output: int = 0,
    structures: Sequence[ProcessStructure] | None = None,
    inputs: Sequence[Signal] = (),
) -> ProcessFit:
    """Fit process models to the simulation error of an output.

    Args:
        records: training records in physical units
        output: column of the output
        structures: form of the transfer function of each input; None takes those with the least
            Bayesian information criterion
        inputs: signals of the problem, for their behaviour between samples; where it is left open
            a staircase is held, and the criterion decides for the others

    Raises:
        UserError: for an output that does not change, and records that are too short
    """
    between = tuple[Intersample | None, ...](
        signal.intersample or ("zero" if stairs else None)
        for signal, stairs in zip(
            inputs or (Signal("u"),) * records[0].u.shape[1], staircases(records), strict=True
        )
    )
    transfer = fit_transfer(records, output, structures, between)
    step = records[0].sampling_time
    reasons = tuple(_reason(transfer, one) for one in transfer.inputs)
    parameters = tuple(() if one is None else _parameters(one, step) for one in transfer.inputs)
    models = tuple(
        None if one is None or reason else _model(values, one.structure, transfer.fit)
        for one, values, reason in zip(transfer.inputs, parameters, reasons, strict=True)
    )
    integrator = any(one is not None and one.structure.integrator for one in transfer.inputs)
    return ProcessFit(
        models,
        tuple(() if reason else p for p, reason in zip(parameters, reasons, strict=True)),
        reasons,
        tuple(None if one is None or not one.acts else one.first for one in transfer.inputs),
        transfer.offset / (step if integrator else 1.0),
        transfer.at_rest,
        transfer.fit,
        transfer.between,
    )


def _reason(transfer: OutputTransfer, one: InputTransfer | None) -> str:
    """Reason that the parameters of an input are withheld; empty where they are not."""
    if one is None:
        return "the input does not move"
    if not one.acts:
        return "no effect of the input is seen"
    if transfer.fit < LEAST_FIT:
        return f"the process models fit {max(transfer.fit, 0.0):.0f} %, below {LEAST_FIT:g} %"
    if one.gain.low * one.gain.high <= 0:
        return "its gain may be zero"
    if any(_stated(lag).interval is None for lag in one.lags[:1]):
        return "the records do not determine its longest time constant"
    return ""


def _stated(one: Interval | ParameterEstimate, unit: str = "") -> Statement:
    """Statement of a gain, a time constant or a delay."""
    bound = "lower" if one.value <= one.lower else "upper" if one.value >= one.upper else ""
    interval = one.low, one.high
    return stated(one.value, interval, unit, at_bound=bound, positive=one.lower > 0.0)


def _parameters(one: InputTransfer, step: float) -> tuple[ParameterEstimate, ...]:
    rate = 1.0 / step if one.structure.integrator else 1.0
    made = [_estimate("gain", one.gain, rate, "")]
    made += [_estimate(f"time constant {k}", lag, step, "s") for k, lag in enumerate(one.lags, 1)]
    if one.zero is not None:
        made.append(_estimate("zero", one.zero, step, "s"))
    made.append(_estimate("delay", one.delay, step, "s"))
    return tuple(made)


def _estimate(name: str, value: Interval, unit: float, label: str) -> ParameterEstimate:
    low, high = _stated(value).interval or (math.nan, math.nan)
    return ParameterEstimate(
        name,
        unit * value.value,
        unit * value.error,
        unit * low,
        unit * high,
        label,
        unit * value.lower,
        unit * value.upper,
    )


def _model(
    values: Sequence[ParameterEstimate], structure: ProcessStructure, fit: float
) -> ProcessModel:
    numbers = [one.value for one in values]
    lags = tuple(numbers[1 : 1 + structure.lags])
    zero = numbers[-2] if structure.zero else 0.0
    return ProcessModel(numbers[0], lags, zero, numbers[-1], structure.integrator, fit)
