"""Neural state-space model that starts as the best linear one.

x[k+1] = A x + B u + f(x, u),  y = C x + D u + g(x, u), or the same with a static function before
the linear system (Hammerstein), after it (Wiener) or both, or with f and g acting through a few
channels only (a static function in feedback with a linear system). The functions are small
networks or polynomials whose last layer starts at zero. Sources: Schoukens, Improved
initialization of state-space artificial neural networks, ECC 2021; Paduart et al., Automatica
46(4), 2010 (polynomials).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models import linear
from asia.models._arrays import tree_size
from asia.models._config import check_at_least, demand
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import LinearFit, Refinement, encoder_of
from asia.models._linear.window_predictor import WindowPredictor
from asia.models._numerics.encoder import affine
from asia.models._numerics.symmetry import SignalTransformations, TransformedRecords
from asia.models._numerics.training_records import ScaledData, check, cut_windows, scaled
from asia.models._state_space.model import (
    LINEAR_RIDGE,
    FittedStateSpace,
    StateCell,
    carried_records,
    encoded,
    encoded_at_rest,
    fit_by_adam,
    fit_encoded,
    in_modes,
    starts_of,
    symmetric,
    with_unit_states,
)
from asia.models._state_space.structure import Basis, Nonlinearity, StateSpaceStructure
from asia.models._steps import TrainableModel
from asia.models.methods import Adam

# Limit on samples times squared parameters of one Levenberg-Marquardt iteration on windows, and on
# the resulting number of windows.
_WORK, _WINDOWS = 2e10, (24, 1000)
# Share of the squared error on short segments that is left when a mode is added that the linear
# model missed. One more than there are lowers it by less.
_MISSED = 0.5


@dataclass(frozen=True)
class Config:
    """Size of the state and of its static functions, and their ridges."""

    order: int | None = None
    """States; None takes the order of the best linear model, but at least 2."""
    nonlinearity: Nonlinearity = "state"
    """Place of the static functions: in the "state" equation and the output, at the "input", at
    the "output", or at "both" ends. "none" leaves them out. "modal" has in the state equation and
    the output every oscillating mode of the linear model times powers of its own amplitude, so
    that its frequency and its damping depend on the amplitude; "none" where no mode oscillates."""
    channels: int | None = None
    """Signals through which f and g act, with nonlinearity "state"; None: on all states and
    outputs directly."""
    basis: Basis = "tanh"
    """A layer of tanh units, or of units sqrt(1 + z^2), or polynomials. "scheduling": products of a
    state or input with scheduling signals alone, with nonlinearity "state" on all states, so that
    the model is linear for constant scheduling signals (LPV)."""
    hidden: int = 8
    """Units of that layer."""
    degree: int = 3
    """Greatest degree of the polynomials, and of a mode times powers of its amplitude; with
    "scheduling" 2 makes the matrices affine in the scheduling signals, 3 quadratic."""
    ridge: float = 1e-5
    """Weight, against the mean squared error in z-scores, of the squared distance of the nonlinear
    weights from their start."""
    delay: int | None = 0
    """Samples by which every input is delayed; None estimates it, see `linear.Config`."""
    symmetry: bool = False
    """Fit the records under every symmetry of the problem that takes inputs to
    inputs and outputs to outputs, and average simulations over these."""
    friction: int = 0
    """Elements of dry friction and hysteresis. Each resists the motion of a learned direction of
    the state, has a state of its own, and can hold the system still."""
    play: int = 0
    """Elements of play (backlash). Each follows a learned direction of state and input within a
    width; what it does not follow acts on state and output."""
    integrators: int = 0
    """Free integrators: states whose pole is held at 1 and which the static functions in the state
    equation do not read."""
    pieces: bool = False
    """Begin fits with short segments of the records, each with its own initial state, which grow to
    the whole records, with Levenberg-Marquardt: fewer local minima where small differences
    grow. An estimated delay is then compared with none by the whole fit."""
    past_fit: bool = False
    """Fit the initial state to the past window by the model itself, with Levenberg-Marquardt,
    instead of only reading it by the encoder."""
    transport: int | None = None
    """Number of an input with positive values, a flow or a speed, at whose pace all inputs are
    carried to where they act: their delay is the longer the smaller it is. The volume on the way
    is estimated; the input itself acts at once as well."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "order", "hidden", "channels")
        check_at_least(2, self, "degree")
        check_at_least(0, self, "friction", "play", "integrators", "transport")
        still = self.transport is None or not self.symmetry
        demand(self, "symmetry", still, "False with transport")
        swings = self.order is None or self.order > self.integrators
        demand(self, "order", swings, "more than the integrators")
        placed = self.channels is None or self.nonlinearity == "state"
        demand(self, "channels", placed, "None without nonlinearity state")
        plain = self.nonlinearity in ("state", "none") and self.channels is None
        demand(
            self,
            "basis",
            plain or self.basis != "scheduling",
            "another one without nonlinearity state on all states",
        )


@dataclass(frozen=True)
class NeuralStateSpace(TrainableModel[Config, FittedStateSpace]):
    """Neural state-space model."""

    label = "neural state-space model"


build = NeuralStateSpace.build


def train(
    model: NeuralStateSpace,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt | Adam,
) -> NeuralStateSpace:
    """Fit the linear model, then all parameters to the simulation error.

    The error is that of all records, or of windows where `linear.windowed` chooses the past window
    as state. Levenberg-Marquardt suits short records and few parameters (its Jacobian takes
    samples x outputs x parameters numbers); the best of `method.starts` initialisations is kept.

    Raises:
        UserError: for records too short or mis-shaped, and for a transport at the pace of an input
            that is not positive.
    """
    check(trajectories, context)
    c = model.config
    scheduled = c.basis != "scheduling" or bool(_scheduling(c, context))
    demand(c, "basis", scheduled, "tanh or polynomial without an input of role scheduling")
    if c.transport is not None:
        # Train on inputs at the outlet of the pipe.
        demand(c, "transport", c.transport < context.nu, f"less than {context.nu}, the inputs")
        transport, behind, known = carried_records(trajectories, context, c.transport)
        plain = replace(model, config=replace(c, transport=None))
        found = train(plain, behind, known, method).fitted
        assert found is not None
        return replace(model, fitted=replace(found, transport=transport))
    if isinstance(method, Adam):
        demand(c, "pieces", not c.pieces, "False with Adam")
        demand(c, "past_fit", not c.past_fit, "False with Adam")
    turned = c.symmetry or (isinstance(method, Adam) and method.symmetry)
    data = TransformedRecords.of(
        trajectories, SignalTransformations.of(context) if turned else None
    )
    if c.integrators and data.turns is None:
        choice = linear.Config(c.order, delay=c.delay, integrators=c.integrators)
        still = linear.scaling_of(trajectories, context, choice)
        data = replace(data, records=scaled(trajectories, still), scaling=still)
    if c.nonlinearity == "state" and not (c.friction or c.play or c.integrators):
        choice = linear.Config(order=c.order, delay=c.delay)
        predictor = linear.windowed(data.records, context, choice, Refinement())
        if predictor is not None:
            return _train_windowed(model, predictor, data, context, method)
    fitted, cost = _train_records(c, data, context, method)
    if c.pieces and c.delay is None and fitted.delay > 0:
        # A linear model of a nonlinear system may find a delay that does not exist.
        other, other_cost = _train_records(replace(c, delay=0), data, context, method)
        fitted = other if other_cost < cost else fitted
    return replace(model, fitted=fitted)


def _train_records(
    c: Config, data: TransformedRecords, context: Context, method: LevenbergMarquardt | Adam
) -> tuple[FittedStateSpace, float]:
    """Train on whole records; return the least cost with Levenberg-Marquardt too."""
    begun = _begun(c, data, context)
    if isinstance(method, LevenbergMarquardt):
        from asia.models._state_space.training import LmOptions, error_on_segments, fit_best

        options = LmOptions(_ridges(c), c.pieces, c.past_fit)
        if c.nonlinearity == "modal" and c.order is None and c.pieces:
            # A linear model takes a mode whose frequency depends on the amplitude for noise.
            wider = replace(c, order=begun[0].order + 2, delay=begun[3])
            more = _begun(wider, data, context)
            errors = [
                error_on_segments(*one[:3], data.scaling, context, method, options)
                for one in (begun, more)
            ]
            begun = more if errors[1] < _MISSED * errors[0] else begun
        structure, *_, delay = begun
        best = fit_best(*begun[:3], data.scaling, context, method, options)
        each = best.params, best.encoder, delay, data.scaling, data.turns, best.past_fit
        return FittedStateSpace(structure, *each), best.cost
    structure, found, used, delay = begun
    rng = np.random.default_rng(context.seed)
    start = starts_of(structure, found, used, 1, data.scaling, rng)[0]
    encoder = encoded_at_rest(structure, encoder_of(used, found, context))
    params = encoded(start, encoder, context)
    late = [r.with_delay(delay) for r in data.every]
    found = fit_encoded(StateCell(structure), params, late, context, method, data.copies)
    return FittedStateSpace(structure, *found, delay, data.scaling, data.turns), np.inf


def _begun(
    c: Config, data: TransformedRecords, context: Context
) -> tuple[StateSpaceStructure, LinearFit, ScaledData, int]:
    """Return the structure, the linear model that it begins with, the records of its fit, their
    inputs delayed, and the delay."""
    least = (1 if c.friction or c.play else 2) + (c.integrators > 0)
    choice = linear.Config(c.order, delay=c.delay, integrators=c.integrators)
    found, delay, used = linear.fit_of_least_order(data.records, context, choice, least)
    if data.turns is not None:
        used = data.with_transformed(used)
        found = symmetric(found, used, data.copies, Refinement(integrators=c.integrators))
    pairs, place = 0, c.nonlinearity
    if place == "modal":
        found, pairs = in_modes(found, used, c.integrators)
        place = "modal" if pairs else "none"
    else:
        found = with_unit_states(found, used, c.integrators)
    structure = StateSpaceStructure(
        found.system.order, context.nu, context.ny, place, c.basis, c.hidden, c.degree,
        c.channels, friction=c.friction, play=c.play, integrators=c.integrators,
        scheduling=_scheduling(c, context), pairs=pairs,
    )  # fmt: skip
    return structure, found, used, delay


def _train_windowed(
    model: NeuralStateSpace,
    predictor: WindowPredictor,
    data: TransformedRecords,
    context: Context,
    method: LevenbergMarquardt | Adam,
) -> NeuralStateSpace:
    """Train with the past window as state, so that no initial state need be learned."""
    from asia.models._state_space.fit import fit_states
    from asia.models._state_space.programs import StateSamples

    c, lags = model.config, predictor.lags
    structure = StateSpaceStructure(
        lags.order, context.nu, context.ny, c.nonlinearity, c.basis, c.hidden, c.degree, c.channels,
        lags, scheduling=_scheduling(c, context),
    )  # fmt: skip
    encoder = affine(lags.selection(), np.zeros(lags.order))
    rng = np.random.default_rng(context.seed)
    if isinstance(method, Adam):
        params = structure.start_windowed(predictor, rng)
        cell = StateCell(structure)
        found = fit_by_adam(cell, params, data.every, context, method, data.copies)
    else:
        starts = [structure.start_windowed(predictor, rng) for _ in range(method.starts)]
        size = tree_size(starts[0])
        most = _WORK / (size**2 * (context.horizon or 1) * context.ny)
        w = cut_windows(data.every, context, int(np.clip(most, *_WINDOWS)))
        samples = StateSamples(encoder(w.window), w.u, w.y, w.weight, known=True)
        # The ridge of the linear model on its training windows applies to this model too.
        ridges = {name: max(r, predictor.ridge) for name, r in _ridges(c).items()}
        time = context.sampling_time
        fits = fit_states(structure, starts, samples, ridges, method, context.log, time)
        found = fits[0].params
    fitted = FittedStateSpace(structure, found, encoder, 0, data.scaling, data.turns)
    return replace(model, fitted=fitted)


def _scheduling(config: Config, context: Context) -> tuple[int, ...]:
    """Return the numbers of the scheduling inputs, for the basis that reads them."""
    if config.basis != "scheduling":
        return ()
    return tuple(j for j, s in enumerate(context.inputs) if s.role == "scheduling")


def _ridges(config: Config) -> dict[str, float]:
    ridge: dict[str, float] = dict.fromkeys(("a", "b", "c", "d", "offset"), LINEAR_RIDGE)
    ridge.update(dict.fromkeys(("f", "s", "r", "read", "act", "dry", "play"), config.ridge))
    return ridge
