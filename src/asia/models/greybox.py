"""Grey-box: the problem's differential equations in physical units, fitted to the records.

model = greybox.build(greybox.Config(saturation=("x1",), spill=True), context)
model = greybox.train(model, trajectories, context, LevenbergMarquardt(iterations=60, starts=8))

Source: Bohlin, Practical Grey-box Process Identification, Springer 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from asia._text import suggestion
from asia.candidate import Context, ParameterEstimates
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.additions import NO_PRIORS, parameter_priors
from asia.models._equations.config import Config, GreyBoxStructure
from asia.models._equations.extension import extended
from asia.models._equations.fit import FittedEquations, fit
from asia.models._equations.identified import equation_lines
from asia.models._equations.initial_state import CaseSteps, simulate_cases
from asia.models._equations.ode import equations
from asia.models._equations.simulate import Effects, effects
from asia.models._equations.starts import cut_segments, with_memory
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.intersample import between
from asia.problem.memory import LEAST_TIME
from asia.problem.physics import Bounds, ParameterRange, Physics, Prior, check_physics

__all__ = ["Bounds", "Config", "GreyBox", "ParameterRange", "Physics", "Prior", "build", "train"]

# Greatest factor on the substeps, for long gaps between irregular samples.
_MOST_SUBSTEPS = 20


@dataclass(frozen=True)
class GreyBox:
    """Grey-box model; `fitted` is None until it is trained."""

    structure: GreyBoxStructure
    fitted: FittedEquations | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in open loop, in physical units.

        The initial state is measured or estimated from the past window (`Config.initial`). The
        result is always finite for finite input.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny).

        Raises:
            ValueError: if the model is not trained or a past window has another length.
        """
        fitted = self._trained()
        expected = (self.structure.n_past_u, self.structure.n_past_y)
        if (past_u.shape[1], past_y.shape[1]) != expected:
            raise ValueError(
                f"grey-box: past windows of {past_u.shape[1]} and {past_y.shape[1]} samples, "
                f"trained with {expected[0]} and {expected[1]}"
            )
        cases = past_u, past_y, u
        return simulate_cases(self.structure, fitted.scales, fitted.prior, fitted.z, cases)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """State of the equations, and the samples that delays still hold back; see
        `asia.candidate.StepModel`.

        Raises:
            ValueError: before training.
        """
        return self.steps(u).initial(past_u, past_y, u)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, see `asia.candidate.StepModel`.

        Raises:
            ValueError: before training.
        """
        return self.steps(u).step(state, u)

    def halved(self) -> GreyBox:
        """The model, integrated with half the step."""
        config = replace(self.structure.config, substeps=2 * self.structure.config.substeps)
        return replace(self, structure=replace(self.structure, config=config))

    def steps(self, like: AnyArray) -> CaseSteps:
        """The steps with arrays of the library of `like`. Raises ValueError before training."""
        return self._numpy_steps if namespace(like) is np else self._steps_like(like)

    @cached_property
    def _numpy_steps(self) -> CaseSteps:
        # Most of what a step needs does not depend on the sample.
        return self._steps_like(np.zeros(0))

    def _steps_like(self, like: AnyArray) -> CaseSteps:
        fitted = self._trained()
        return CaseSteps.of(self.structure, fitted.scales, fitted.prior, fitted.z, like)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "_numpy_steps"}

    def with_parameters(self, names: Sequence[str]) -> _SteppedParameters:
        """The model with these physical parameters as its last state, where an observer can change
        them.

        Raises:
            UserError: for an unknown name.
        """
        known = self.structure.equations.parameters
        for name in names:
            if name not in known:
                raise UserError(
                    f"parameter '{name}' is unknown{suggestion(name, known)} (the equations have "
                    f"{', '.join(known)})"
                )
        return _SteppedParameters(self, tuple(known.index(name) for name in names))

    def parameters(self) -> dict[str, float]:
        """Physical parameters, and those of the additions that have a physical meaning: limits
        of states, spilled fractions, offsets of outputs and delays in samples."""
        return self._parameters_at(self._trained().z)

    def estimates(self, trajectories: Sequence[Trajectory], context: Context) -> ParameterEstimates:
        """Estimate the uncertainty of the parameters from the records of the fit.

        Returns:
            Standard errors, intervals and correlations, with the residuals' correlation in time
            taken into account, and the equations.
        """
        from asia.models._equations.identified import Around

        fitted = self._trained()
        segments = cut_segments(self.structure, trajectories, context.horizon)
        around = Around(self.structure, fitted, segments, self._parameters_at)
        return around.estimates(self.equations())

    def equations(self) -> list[str]:
        """Equations with the fitted numbers put in, and the additions to them, one a line."""
        fitted = self._trained()
        return equation_lines(self.structure, fitted.scales, self._effect(fitted.z))

    def _parameters_at(self, z: Array) -> dict[str, float]:
        config, system, effect = self.structure.config, self.structure.equations, self._effect(z)
        report = dict(zip(system.parameters, effect.parameters, strict=True))
        for name in self.structure.learned.spans:
            del report[f"{name} low"], report[f"{name} high"]
        for name in self.structure.learned.rates:
            del report[f"{name} rate"]
        for i, name in enumerate(system.states):
            if name in config.saturation:
                report[f"{name} limit"] = effect.limits[i]
                if config.spill:
                    report[f"{name} spilled fraction"] = effect.spill[i]
        for i, name in enumerate(system.outputs):
            if name in config.offset and name not in system.states:
                report[f"{name} offset"] = effect.output_offset[i]
        if config.input_delay:
            report |= {f"{n} delay": d for n, d in zip(system.inputs, effect.delay, strict=True)}
        return {name: float(value) for name, value in report.items()}

    def _effect(self, z: Array) -> Effects:
        rows = effects(self.structure, self._trained().scales.for_rows(), z[:, None])
        return Effects(*(np.asarray(a)[..., 0] for a in rows))

    def _trained(self) -> FittedEquations:
        if self.fitted is None:
            raise ValueError("grey-box: the model is not trained; call greybox.train first")
        return self.fitted


@dataclass(frozen=True)
class _SteppedParameters:
    """Step model whose state is that of the equations and (B, p) parameters, which stay."""

    model: GreyBox
    places: tuple[int, ...]

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        xp, cases = namespace(u), self.model.steps(u)
        nominal = cases.effect.parameters[np.array(self.places)].T
        return cases.initial(past_u, past_y, u), xp.repeat(nominal, len(u), axis=0)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        own, chosen = state
        xp, cases = namespace(u), self.model.steps(u)
        found: list[Any] = []
        # The equations have one set of parameters for all cases, so each case goes alone.
        for i in range(len(u)):
            values = list(cases.effect.parameters)
            for column, place in enumerate(self.places):
                values[place] = chosen[i : i + 1, column]
            one = replace(cases, effect=cases.effect._replace(parameters=xp.stack(values)))
            found.append(one.step(tuple(part[i : i + 1] for part in own), u[i : i + 1]))
        own = tuple(xp.concatenate([after[k] for after, _ in found]) for k in range(len(own)))
        return (own, chosen), xp.concatenate([y for _, y in found])


def build(config: Config, context: Context) -> GreyBox:
    """Build an untrained model.

    Raises:
        ValueError: if the problem has no physics or the config names an unknown state or output.
        UserError: if the physics do not fit the signals, or measured initial states are requested
            for states that are not measured.
    """
    physics = context.physics
    if config.physics:
        from asia.problem.physics_text import read_physics

        physics = read_physics(config.physics[0])
    if physics is None:
        raise ValueError(
            "grey-box: the problem has no [physics]; give states and dynamics there or in "
            "`Config.physics`, or use a black-box family"
        )
    inputs, outputs = ([s.name for s in group] for group in (context.inputs, context.outputs))
    if config.physics:
        check_physics(physics, inputs, outputs)
    system = equations(physics, inputs, outputs)
    bounds = [physics.bounds.get(name, Bounds()) for name in system.states]
    # A shorter lag would make an explicit step unstable.
    least = 0.5 * context.sampling_time / config.substeps
    constants = ((name, least if name == LEAST_TIME else c) for name, c in system.constants)
    system = replace(system, constants=tuple(constants))
    priors = NO_PRIORS
    if config.prior_width is not None:
        rows = [(text, p.mean, p.deviation) for text, p in physics.priors.items()]
        rows += [(text, mean, deviation) for text, mean, deviation, _ in config.priors]
        priors = parameter_priors(system, rows, config.prior_width)
    structure = GreyBoxStructure(
        equations=system,
        config=config,
        ranges=tuple(physics.parameters.values()),
        low=tuple(-np.inf if b.min is None else float(b.min) for b in bounds),
        high=tuple(np.inf if b.max is None else float(b.max) for b in bounds),
        sampling_time=context.sampling_time,
        n_past_u=context.n_past_u,
        n_past_y=context.n_past_y,
        priors=priors,
        problem_states=len(physics.states) if system.rest else None,
        time_step=next((i for i, s in enumerate(context.inputs) if s.role == "time_step"), None),
    )
    if structure.time_step is not None and (config.input_delay or config.discover):
        raise UserError(
            "greybox.Config: input_delay and discover need one sampling time: leave them out with "
            "irregular samples"
        )
    return GreyBox(replace(structure, states_measured=_is_measured(structure, context)))


def _is_measured(structure: GreyBoxStructure, context: Context) -> bool:
    requested = structure.config.initial
    bent = structure.config.sensor is not None
    seen = len(structure.measured_states) == structure.nx and not bent
    possible = context.n_past_y > 0 and seen and not structure.config.hides
    if requested == "measured" and not possible:
        raise UserError(
            'greybox.Config: initial is "measured", but the past window does not show every '
            'state; use "estimated" or None'
        )
    # The buffer of a delay fills over the whole past window.
    usual = context.horizon is not None and not structure.equations.delays
    measured = possible and (requested == "measured" or (requested is None and usual))
    driven = [name for name in structure.config.lag if name in structure.equations.inputs]
    if measured and driven:
        raise UserError(
            f"greybox.Config: a lag of an input ('{driven[0]}') has a state of its own, which no "
            'measurement shows; set initial to "estimated" with it'
        )
    return measured


def train(
    model: GreyBox, trajectories: Sequence[Trajectory], context: Context, method: LevenbergMarquardt
) -> GreyBox:
    """Fit the model to the simulation error of whole records (with a horizon: of windows).

    Initial states of the records are estimated with the parameters. A refit starts from the fold
    models. Logs the cost, which is the mean squared normalised error plus the ridge.

    Raises:
        UserError: for inputs that are not held where the equations delay a signal, and noise models
            with irregular samples
    """
    acting = between(context.inputs, trajectories, model.structure.config.intersample)
    if acting.memory and model.structure.equations.delays:
        raise UserError(
            "greybox: delay, plug_flow and plug_mean need inputs that are held between samples: "
            'set intersample to "zero"'
        )
    structure = replace(model.structure, intersample=acting if acting.memory else None)
    segments = cut_segments(structure, trajectories, context.horizon)
    if structure.time_step is not None:
        if method.noise_model != "white":
            raise UserError(
                "greybox.train: noise_model needs one sampling time: leave it out with irregular "
                "samples"
            )
        # As many substeps as keep the longest at the length that a regular one would have.
        longest = max(float(t.u[:, structure.time_step].max()) for t in trajectories)
        more = int(np.clip(np.ceil(longest / structure.sampling_time), 1, _MOST_SUBSTEPS))
        config = replace(structure.config, substeps=more * structure.config.substeps)
        structure = replace(structure, config=config)
    structure = with_memory(extended(structure, segments), segments)
    near = [
        one.fitted
        for one in context.fold_models()
        if isinstance(one, GreyBox) and one.fitted and one.structure.layout == structure.layout
    ]
    fitted = fit(structure, segments, method, context.seed, context.log, near)
    if structure.config.discover:
        from asia.models._equations.discovery import discover

        structure, fitted = discover(structure, segments, fitted, method)
    structure = with_memory(structure, segments, fitted.z)
    return replace(model, structure=structure, fitted=fitted)
