"""Model of a network family: settings and simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._networks.structure import (
    Cell,
    FeatureMap,
    Features,
    NetworkConfig,
    NetworkStructure,
    OneSample,
    Params,
    Restartable,
    SequenceMap,
    Simulate,
    linear_output,
    rollout,
    trace,
)
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import laid, whole
from asia.models._numerics.symmetry import SignalTransformations, TransformedRecords
from asia.models._numerics.training_records import (
    ScaledData,
    batch,
    check,
    flat_past,
    regress_outputs,
)
from asia.models._steps import mean
from asia.models.methods import NetworkMethod

# Simulation of a network with given parameters: in NumPy, or in JAX where that is worth it.
#
# JAX compiles anew for each length and each number of windows. Measured in fresh processes of one
# thread, in seconds of processor time; those of JAX include its import (0.35) and compilation:
#
# | network | windows x samples | NumPy | JAX | |---|---|---|---| | GRU, 32 units | 1 x 1 000 |
# 0.01 | 0.8 | | LSTM, 2 x 256 units | 1 x 3 000 | 0.5 | 1.2 | | LSTM, 64 units | 4 000 x 50 | 0.2
# | 1.1 | | LSTM, 256 units | 4 000 x 50 | 1.6 | 2.4 | | convolutions, 16 channels | 4 000 x 50 |
# 0.4 | 1.5 | | Transformer, 32 channels | 256 x 50 | 0.2 | 1.2 | | Transformer, 32 channels | 4
# 000 x 50 | 3.1 | 2.9 | | GRU, 32 units | 1 x 100 000 | 1.3 | 0.8 | | cascaded LTC, 2 x 16 states
# | 1 x 100 000 | 2.8 | 1.0 |
#
# Width and windows are no reason for JAX, steps in time are: each costs NumPy 10 to 30 us. One
# simulation is worth its compilation from about 70 000 steps on; the switch lies higher, because
# checks ask a model for many lengths. It depends only on shapes, so that a request has the same
# answer in every process.

_MOST_STEPS = 200_000
# Windows of a cell, and samples of a structure that computes all of them at once, in NumPy at a
# time: few enough for their arrays to stay in the processor's cache.
_ROWS, _SAMPLES = 256, 2048


def outputs_of(cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray) -> AnyArray:
    """Outputs (B, T, ny) of a network, all z-scored NumPy arrays of one precision: window (B, d)
    and u (B, T, nu)."""
    return _simulated(rollout, cell, params, window, u)


def features_of(cell: Cell | FeatureMap, params: Params, window: AnyArray, u: AnyArray) -> AnyArray:
    """Features (B, T, hidden) that the outputs are read from."""
    return _simulated(trace, cell, params, window, u)


def is_compiled(windows: int, samples: int) -> bool:
    """Return whether a simulation of so many windows of so many samples is left to JAX."""
    return -(-windows // _ROWS) * samples > _MOST_STEPS


def _simulated(
    simulate: Simulate, cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray
) -> AnyArray:
    count, samples = u.shape[:2]
    if is_compiled(count, samples):
        from asia.models._networks.compiled import compiled

        return compiled(simulate, cell, params, window, u)
    rows = _ROWS
    if isinstance(cell, FeatureMap | SequenceMap):
        rows = max(1, _SAMPLES // max(samples, 1))
    starts = range(0, max(count, 1), rows)
    with np.errstate(all="ignore"):
        parts = [simulate(cell, params, window[i : i + rows], u[i : i + rows]) for i in starts]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


# Model of a network family: a structure, its parameters and the scaling of its signals.

Prepare = Callable[[Params, ScaledData, Scaling], Params]
"""Function that makes the initial parameters from z-scored records: for example a linear fit."""


@dataclass(frozen=True)
class NetworkModel:
    """Network as a model."""

    cell: NetworkStructure  # Structure of the network
    params: Params  # Parameters of the network
    scaling: Scaling | None = None  # Scaling from physical units to z-scores; None before training
    others: tuple[Params, ...] = ()
    """Parameters of further members, whose simulations are averaged with that of `params`."""
    turns: SignalTransformations | None = None
    """Symmetries over which simulations are averaged; None: none."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units: past inputs (B, n_past_u, nu), past outputs (B, n_past_y,
        ny), inputs u (B, H, nu) -> outputs (B, H, ny), float64.

        Raises:
            UserError: before training.
        """
        if self.turns is None:
            return self._simulated(past_u, past_y, u)
        return self.turns.averaged(self._simulated, past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training, and for a structure that cannot go sample by sample.
        """
        if self.turns is not None:
            return self.turns.initial(replace(self, turns=None), past_u, past_y, u)
        scaling, cell = self._scaling(), self._sequential()
        past = flat_past(scaling.inputs(past_u), scaling.outputs(past_y)).astype(np.float32)
        begin = cell.initial if isinstance(cell, Cell) else cell.begin
        return [begin(params, past) for params in self._members(past)]

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; the output is the mean over the members, each in single
        precision as the network computes."""
        if self.turns is not None:
            return self.turns.step(replace(self, turns=None), state, u)
        scaling, cell = self._scaling(), self._sequential()
        advance = cell.step if isinstance(cell, Cell) else cell.advance
        v = scaling.inputs(u).astype(np.float32)
        after, outputs = list[Any](), list[AnyArray]()
        for params, member in zip(self._members(v), state, strict=True):
            member, features = advance(params, member, v)
            after.append(member)
            outputs.append(cell.output(params, features, v).astype(np.float64))
        return after, scaling.physical(mean(outputs))

    def _sequential(self) -> Cell | OneSample:
        if not isinstance(self.cell, Cell | OneSample):
            raise UserError(f"{type(self.cell).__name__} has no form that goes sample by sample")
        return self.cell

    def _members(self, like: AnyArray) -> list[Params]:
        members = [self.params, *self.others]
        if namespace(like) is np:
            return members
        import jax

        # The parts that depend only on parameters are then found by the same functions.
        return [jax.tree.map(jax.numpy.asarray, params) for params in members]

    def _scaling(self) -> Scaling:
        if self.scaling is None:
            raise UserError("network model: not trained yet; call train first")
        return self.scaling

    def _simulated(self, past_u: Array, past_y: Array, u: Array) -> Array:
        scaling = self._scaling()
        past = flat_past(scaling.inputs(past_u), scaling.outputs(past_y))
        arrays = past.astype(np.float32), scaling.inputs(u).astype(np.float32)
        members = (self.params, *self.others)
        outputs = [np.asarray(outputs_of(self.cell, p, *arrays), np.float64) for p in members]
        return scaling.physical(mean(outputs))


def train_network(
    model: NetworkModel,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: NetworkMethod,
    prepare: Prepare | None = None,
) -> NetworkModel:
    """Fit a network to the simulation error.

    Args:
        model: untrained network.
        trajectories: training records.
        context: context of the fit.
        method: training method.
        prepare: makes the initial parameters; None solves the output layer `out_w`, `out_b` by
            ridge regression where the structure reads it as `linear_output` does.

    Raises:
        UserError: for records too short or mis-shaped, and for a method that does not go with the
            structure.
    """
    from asia.models._networks.training import fit  # imports JAX, which a simulation must not

    check(trajectories, context)
    data = TransformedRecords.of(
        trajectories, SignalTransformations.of(context) if method.symmetry else None
    )
    every, scaling, turns = data.every, data.scaling, data.turns
    cell = model.cell
    if method.members > 1 and not isinstance(cell, Restartable):
        raise UserError(
            f"{type(method).__name__}: members is {method.members}, but this family starts from "
            "its data and not from a seed; leave members at 1"
        )
    members: list[Params] = []
    # Members are trained sequentially by one compiled program: three in parallel, by jax.vmap, take
    # 0.8 times as long where 8 short chunks are side by side, but 1.0 to 1.25 times where 31 are.
    for i in range(method.members):
        params, own = model.params, replace(context, seed=context.seed + i)
        if i > 0 and isinstance(cell, Restartable):
            params = cell.parameters(own)
        if prepare is None:
            params = with_output_layer(cell, params, every, context)
        else:
            params = prepare(params, data.records, scaling)
        trained = fit(
            cell,
            params,
            every,
            own,
            method,
            lambda p: NetworkModel(cell, p, scaling, turns=turns),
            data.copies,
        )
        members.append(trained)
    return NetworkModel(cell, members[0], scaling, tuple(members[1:]), turns)


def as_built(params: Params, records: ScaledData, scaling: Scaling) -> Params:
    """Return the parameters unchanged: a `Prepare` for families that start from random weights."""
    del records, scaling
    return params


def with_output_layer(
    cell: NetworkStructure, params: Params, records: ScaledData, context: Context
) -> Params:
    """Solve the output layer by ridge regression on the untrained states; return the parameters
    unchanged where there is no such layer."""
    if "out_w" not in params or (isinstance(cell, SequenceMap) and not isinstance(cell, Cell)):
        return params
    samples = batch(records, context)
    data = whole(samples) if context.horizon is None else laid(samples, context.horizon)
    traced = features_of(cell, params, data.window, data.u)
    x, u, y, weight = (np.asarray(v, np.float64) for v in (traced, data.u, data.y, data.weight))
    rows = len(params["out_w"])
    if rows == x.shape[-1] + u.shape[-1]:
        x = np.concatenate([x, u], axis=-1)
    elif rows != x.shape[-1]:
        return params
    if not np.isfinite(x).all():
        return params
    x = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=-1)

    def solve(x: Array, y: Array) -> AnyArray:
        ridge = 0.01 * len(x) * np.eye(rows + 1)
        ridge[-1, -1] = 1e-6
        return np.linalg.solve(x.T @ x + ridge, x.T @ y)

    x, y, weight = (v.reshape(-1, v.shape[-1]) for v in (x, y, weight))
    solution = regress_outputs(x, y, weight, solve).astype(np.float32)
    return {**params, "out_w": solution[:-1], "out_b": solution[-1]}


# Families whose model is one network: settings, a structure, `build`, `train`.
#
# @dataclass(frozen=True) class Config: ...
#
# @dataclass(frozen=True) class KoopmanMap(Driven[Config]): ...
#
# build, train = network_family(Config, KoopmanMap)

C = TypeVar("C", bound=NetworkConfig)


@dataclass(frozen=True)
class Driven(Generic[C]):
    """Structure that reads its inputs through `drive`, and its outputs by a linear layer."""

    config: C  # Settings of the family
    drive: Features = field(default=Features(), kw_only=True)
    """The inputs and the functions of them."""

    @classmethod
    def of(cls, config: C, context: Context) -> Any:
        """Structure for a problem. Raises UserError if settings and problem do not go together."""
        del context
        return cls(config, drive=Features(config.features))

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        raise NotImplementedError

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output (..., ny), linear in the features (..., hidden) and in u (..., nu)."""
        return linear_output(params, features, u)

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare | None:
        """Function that makes the parameters from which training starts.

        Returns:
            None to solve the output layer of the untrained parameters by ridge regression.

        Raises:
            UserError: for records that it cannot start from.
        """
        del trajectories, context
        return None


Build: TypeAlias = Callable[[C, Context], NetworkModel]
"""Type of a family's `build`, from settings and context."""
Train: TypeAlias = Callable[
    [NetworkModel, Sequence[Trajectory], Context, NetworkMethod], NetworkModel
]
"""Type of a family's `train`."""


def network_family(config: type[C], structure: type[Driven[C]]) -> tuple[Build[C], Train]:
    """Make `build` and `train` of the family with these settings and this structure."""
    kind, name = config, config.__module__.rpartition(".")[2]

    def build(config: C, context: Context) -> NetworkModel:
        """Build an untrained network initialised from `context.seed`. Raises UserError if the
        settings are of another family or do not go with the problem."""
        if not isinstance(config, kind):
            raise UserError(f"{name}.build: expected {name}.Config, not {type(config).__name__}")
        cell = structure.of(config, context)
        return NetworkModel(cell, cell.parameters(context))

    def train(
        model: NetworkModel,
        trajectories: Sequence[Trajectory],
        context: Context,
        method: NetworkMethod,
    ) -> NetworkModel:
        """Fit the network to the simulation error. Raises UserError for records too short or
        mis-shaped."""
        check(trajectories, context)
        cell = model.cell
        if not isinstance(cell, structure):
            raise UserError(f"{name}.train: expected a model that {name}.build has made")
        start = cell.start(trajectories, context)
        seen = trajectories
        if method.symmetry:
            seen = SignalTransformations.of(context).turned(trajectories)
        cell = replace(cell, drive=cell.drive.fitted(seen))
        return train_network(replace(model, cell=cell), trajectories, context, method, start)

    for function in (build, train):
        # Attribute the function to the family's module, for readers and for pickles by reference.
        function.__module__, function.__qualname__ = config.__module__, function.__name__
    return build, train
