"""Families whose model is one network: settings, a structure, `build`, `train`.

@dataclass(frozen=True)
class Config: ...

@dataclass(frozen=True)
class KoopmanMap(Driven[Config]): ...

build, train = network_family(Config, KoopmanMap)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

from asia.candidate import Context
from asia.data import Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray
from asia.models._data.records import check
from asia.models._data.turns import SignalTurns
from asia.models._networks.features import Features, NetworkConfig
from asia.models._networks.layers import linear_output
from asia.models._networks.network import NetworkModel, Prepare, train_network
from asia.models._networks.structure import Params
from asia.models.methods import NetworkMethod

C = TypeVar("C", bound=NetworkConfig)
Own = TypeVar("Own", bound=NetworkConfig, contravariant=True)


@dataclass(frozen=True)
class Driven(Generic[C]):
    """Structure that reads its inputs through `drive`, and its outputs by a linear layer."""

    config: C
    """Settings of the family."""
    drive: Features = field(default=Features(), kw_only=True)
    """The inputs and the functions of them."""

    @classmethod
    def of(cls, config: C, context: Context) -> Any:
        """Structure for a problem.

        Raises:
            UserError: if settings and problem do not go together.
        """
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


class Build(Protocol[Own]):
    """Type of a family's `build`."""

    def __call__(self, config: Own, context: Context) -> NetworkModel:
        """Build an untrained network."""
        ...


class Train(Protocol):
    """Type of a family's `train`."""

    def __call__(
        self,
        model: NetworkModel,
        trajectories: Sequence[Trajectory],
        context: Context,
        method: NetworkMethod,
    ) -> NetworkModel:
        """Fit the network."""
        ...


def network_family(config: type[C], structure: type[Driven[C]]) -> tuple[Build[C], Train]:
    """Make `build` and `train` of the family with these settings and this structure."""
    kind, name = config, config.__module__.rpartition(".")[2]

    def build(config: C, context: Context) -> NetworkModel:
        """Build an untrained network initialised from `context.seed`.

        Raises:
            UserError: if the settings are of another family or do not go with the problem.
        """
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
        """Fit the network to the simulation error.

        Raises:
            UserError: for records too short or mis-shaped.
        """
        check(trajectories, context)
        cell = model.cell
        if not isinstance(cell, structure):
            raise UserError(f"{name}.train: expected a model that {name}.build has made")
        start = cell.start(trajectories, context)
        seen = trajectories
        if method.symmetry:
            seen = SignalTurns.of(context).turned(trajectories)
        cell = replace(cell, drive=cell.drive.fitted(seen))
        return train_network(replace(model, cell=cell), trajectories, context, method, start)

    for function in (build, train):
        # Attribute the function to the family's module, for readers and for pickles by reference.
        function.__module__, function.__qualname__ = config.__module__, function.__name__
    return build, train
