"""Physics with learned terms, for problems whose states are all measured.

    model = physics_net.build(physics_net.Config(linear=True), context)
    model = physics_net.train(model, trajectories, context, LevenbergMarquardt(iterations=15))

The equations of [physics] start from the last measured outputs. Equations without free parameters
are known kinematics and only get a gain; the others get sparse linear terms, a disturbance state,
and a feed-forward or recurrent network for what is left. The equations and their linear terms are
fitted first, by Levenberg-Marquardt on windows of all records, also those that a method holds out;
a network, or Adam, then starts from there.
Sources: Piga and Forgione (physics-residual LSTM, kinematic gains); Wipf and Nagarajan, NeurIPS
2007 (reweighted ridge).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import VALIDATION_SCORES, Context
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.models import recurrent
from asia.models._config import check_at_least, check_choice, demand
from asia.models._equations.measured import (
    Disturbance,
    InputLag,
    LimitedScore,
    MeasuredCell,
    MeasuredEquations,
    NetworkKind,
    TermNetwork,
    made_by_inputs,
    measured_sizes,
    most_probable,
    outputs_of_states,
    readable_signals,
    single_precision,
)
from asia.models._equations.ode import equations
from asia.models._least_squares import LevenbergMarquardt
from asia.models._networks.network import NetworkModel, as_built, train_network
from asia.models._networks.structure import dense, zeros
from asia.models._noise.model import refuse_noise
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import check, past_length, scaled, whole_windows
from asia.models._steps import WrappedModel
from asia.models.methods import NetworkMethod
from asia.problem.physics import parse_expression

__all__ = ["Config", "build", "train"]

_LONGEST = 100
# Initial time constant of the lag, without and with corrections, with which a lag is small.
_LAG_SAMPLES, _LAG_SAMPLES_CORRECTED = 2.0, 0.6
# Validation scores reserved for the network.
_RESERVED = 100


@dataclass(frozen=True)
class Config:
    """Additions to the equations of [physics]."""

    linear: bool = False
    """Give every equation with free parameters an offset and linear terms in the states and
    parameter-free definitions that the equations read."""
    sparsity: float = 3e-4
    """Least benefit of a linear term that is kept; 0 keeps all."""
    ridge: float = 1e-3
    """Weight of the squared linear terms before that selection, against the loss."""
    lag: bool = True
    """Let the inputs act through a first-order lag with a learned time constant."""
    gain: bool = True
    """Give known kinematics a learned factor."""
    disturbance: bool = False
    """Add a bounded slow disturbance that opposes the acceleration."""
    network: NetworkKind | None = None
    """Network for what is left: "mlp", "rnn", "gru", "lstm", or None for none."""
    hidden: int = 32
    """Units of a layer of the network."""
    layers: int = 1
    """Layers of a recurrent network."""
    size: float = 1.0
    """Largest effect of the network, as a share of the rates measured."""
    robust: float | None = 0.3
    """Error at which the loss on windows changes from square to linear, in standard deviations of
    the output; None is least squares."""
    equations: int = 15
    """Iterations on the equations before a network method."""
    windows: int = 240
    """Greatest number of training windows."""
    delay: bool = False
    """Let known kinematics read the other states at a learned delay."""
    symmetry: bool = False
    """Show the network its signals under the symmetries of the problem: a random one for
    each window in training, the mean over all in simulation. It needs [physics.corrections]."""
    prior: float = 0.01
    """Weight of the squared deviations from [physics.priors] against the loss."""
    reach: float = 3.0
    """Inputs of the network are bounded to this many standard deviations."""

    def __post_init__(self) -> None:
        check_choice(self, "network", (None, "mlp", "rnn", "gru", "lstm"))
        check_at_least(1, self, "hidden", "layers", "windows")
        check_at_least(0, self, "equations", "sparsity", "ridge")
        demand(self, "size", self.size > 0, "a positive share")
        demand(self, "reach", self.reach > 0, "a positive number of standard deviations")
        demand(self, "robust", self.robust is None or self.robust > 0, "None or positive")


@dataclass(frozen=True)
class PhysicsNet(WrappedModel[NetworkModel]):
    """Physics with learned terms; `network` holds the fitted cell, its parameters and scaling."""

    config: Config
    network: NetworkModel

    def _trained(self) -> NetworkModel:
        return self.network

    def parameters(self) -> dict[str, float]:
        """Parameters of the equations in their physical units, of the first member where there
        are several, and the lag of the inputs in seconds."""
        cell = self.network.cell
        assert isinstance(cell, MeasuredCell)
        return cell.parameters(self.network.params)


def build(config: Config, context: Context) -> PhysicsNet:
    """Build an untrained model.

    Raises:
        UserError: if the problem has no [physics] or the past window does not show every state.
    """
    physics = context.physics
    if physics is None:
        raise UserError(
            "physics_net: the problem has no [physics]; give states and dynamics, or use a "
            "black-box family"
        )
    given = equations(physics, [s.name for s in context.inputs], [s.name for s in context.outputs])
    if given.delays:
        raise UserError("physics_net: the equations delay a signal; use greybox or hybrid")
    shown = outputs_of_states(given, context)
    places = tuple(physics.corrections)
    priors = {f"[physics.priors] {text}": p for text, p in physics.priors.items()}
    prior_terms = tuple((n, parse_expression(n.split("] ")[1], n)) for n in priors)
    system = replace(
        given,
        parameters=(*given.parameters, *places),
        constants=tuple((k, v) for k, v in given.constants if k not in places),
        definitions=(*given.definitions, *prior_terms),
    )
    closures = [system.closure(e) for e in system.dynamics]
    measured = MeasuredEquations(
        system=system,
        ranges=tuple(physics.parameters.values()),
        order=tuple(shown[s] for s in system.states),
        dynamic=tuple(i for i, names in enumerate(closures) if names & set(given.parameters)),
        corrections=places,
        priors=tuple((name, p.mean, p.deviation) for name, p in priors.items()),
    )
    read = readable_signals(given, system, context)
    if config.symmetry and not (places and context.symmetry and config.network):
        raise UserError(
            "physics_net.Config: symmetry is for a network at [physics.corrections] of a problem "
            "with [symmetry]; leave symmetry out"
        )
    network = None
    if config.network is not None:
        inner = None
        if config.network != "mlp":
            inner = recurrent.Config(
                cell=config.network, hidden=config.hidden, layers=config.layers
            )
        made = tuple(k for k, n in enumerate(read) if places and made_by_inputs(system, n))
        network = TermNetwork(
            config.network, inner, config.size, config.reach, made, config.symmetry
        )
    sampling_time, past_inputs = context.sampling_time, context.n_past_u > 0
    cell = MeasuredCell(
        physics=measured,
        read=read,
        sampling_time=sampling_time,
        past_inputs=past_inputs,
        lag=InputLag(sampling_time, past_inputs) if config.lag else None,
        gain=config.gain,
        linear=config.linear,
        disturbance=Disturbance(sampling_time) if config.disturbance else None,
        network=network,
        delay=config.delay,
        ridge=config.ridge if places else 0.0,
        prior_weight=config.prior,
    )
    return PhysicsNet(config, NetworkModel(cell, _parameters(cell, config, context)))


def train(
    model: PhysicsNet,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt | NetworkMethod,
) -> PhysicsNet:
    """Fit the equations to windows; with a network method, train everything from there.

    Members differ in the seed of the network and of the windows drawn.

    Raises:
        UserError: for records too short or mis-shaped, for a network without a network method, and
            for several members that would share the validation scores of a fit.
    """
    check(trajectories, context)
    cell, config, network = model.network.cell, model.config, model.network
    assert isinstance(cell, MeasuredCell)
    validated = method.stop == "validation" and context.validation_score is not None
    if not isinstance(method, LevenbergMarquardt) and method.members > 1:
        if validated:
            raise UserError(
                f"physics_net: members is {method.members} and stop is 'validation', but there are "
                f"{VALIDATION_SCORES} validation scores a fit; leave one of them out"
            )
        fitted: list[NetworkModel] = []
        for i in range(method.members):
            own = replace(context, seed=context.seed + i)
            drawn = replace(network, params=_parameters(cell, config, own))
            member = replace(model, network=drawn)
            fitted.append(train(member, trajectories, own, replace(method, members=1)).network)
        others = tuple(member.params for member in fitted[1:])
        return replace(model, network=replace(fitted[0], others=others))
    if isinstance(method, LevenbergMarquardt):
        if config.network is not None:
            raise UserError(
                "physics_net: LevenbergMarquardt fits only the equations; train the network by "
                "Adam or leave network at None"
            )
        refuse_noise(method, "physics_net without a network method")
    scaling = Scaling.of(trajectories)
    sizes = measured_sizes(cell, trajectories, scaling, context)
    network = replace(network, params={**network.params, "fixed": sizes}, scaling=scaling)
    judge = None
    if validated and context.validation_score is not None:
        reserve = 0 if isinstance(method, LevenbergMarquardt) else _RESERVED
        judge = LimitedScore(context.validation_score, network, VALIDATION_SCORES - reserve)
    first = method
    if not isinstance(first, LevenbergMarquardt):
        first = LevenbergMarquardt(iterations=config.equations)
    if first.iterations > 0:
        # Import of JAX, which a trained model does not need.
        from asia.models._equations.measured_terms import TermPenalties, fit_equations

        records = scaled(trajectories, scaling)
        shortest = min(len(r) for r in records) - past_length(context)
        horizon = context.horizon or min(_LONGEST, shortest)
        params = fit_equations(
            replace(cell, network=None),
            network.params,
            whole_windows(records, context, horizon, config.windows),
            TermPenalties(config.robust, config.ridge, config.sparsity),
            first,
            context.log,
            judge,
        )
        network = replace(network, params=single_precision(params))
    if not isinstance(method, LevenbergMarquardt):
        if judge is not None:
            left = VALIDATION_SCORES - judge.asked - 1
            method = replace(method, every=max(method.every, -(-method.steps // left)))
        network = train_network(network, trajectories, context, method, as_built)
    return replace(model, network=network)


def _parameters(cell: MeasuredCell, config: Config, context: Context) -> dict[str, Any]:
    """Untrained parameters: the middle of the ranges, nothing learned."""
    rng = np.random.default_rng(context.seed)
    nd, nr, nc = cell.physics.nd, len(cell.read), cell.physics.nc
    params: dict[str, Any] = {
        "physical": most_probable(cell),
        "gain": zeros(len(cell.physics.kinematic) if cell.gain else 0),
    }
    if config.lag:
        samples = _LAG_SAMPLES_CORRECTED if cell.physics.corrections else _LAG_SAMPLES
        params["log_lag"] = np.float32(np.log(samples * context.sampling_time))
    if config.linear:
        params |= {"linear": zeros(nr, nc), "offset": zeros(nc)}
    if config.delay:
        params["delay"] = zeros(nd)
    if config.disturbance:
        seconds = (context.horizon or _LONGEST) * context.sampling_time
        params |= {
            "d_start": np.full(nd, 0.7, np.float32),
            "d_bound": np.full(nd, np.log(0.5), np.float32),
            "d_gain": np.full(nd, 0.5 / seconds, np.float32),
            "d_decay": np.full(nd, 0.5 / seconds, np.float32),
        }
    if config.network == "mlp":
        params["net"] = {
            "w1": dense(rng, cell.net_inputs, config.hidden),
            "b1": zeros(config.hidden),
            "w2": dense(rng, config.hidden, config.hidden),
            "b2": zeros(config.hidden),
        }
    elif cell.network is not None and cell.network.recurrent is not None:
        like = replace(context, inputs=context.inputs[:1] * cell.net_inputs, n_past_u=0, n_past_y=1)
        if cell.physics.corrections:
            params["start_w"] = dense(rng, cell.net_inputs, config.hidden)
        params["net"] = {
            "layers": recurrent.RecurrentCell(cell.network.recurrent).parameters(like)["layers"]
        }
    if config.network is not None:
        params |= {"out_w": zeros(config.hidden, nc), "out_b": zeros(nc)}
    return params
