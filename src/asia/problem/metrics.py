"""The metrics of the field, and those that installed packages add: one declaration each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asia._plugins import parts_of
from asia._text import suggestion
from asia.data.trajectory import Array
from asia.errors import UserError

TrainingLoss = Literal["mse", "mae", "huber"]

MEE = "mee"
"""The test metric that is a table: Mean Euclidean Error by group of outputs and step."""
_GROUP = "asia.metrics"


@dataclass(frozen=True)
class Metric:
    """Distance of a simulation from the measurement, one number per output."""

    name: str
    """Name in problem files, lock files and ledgers."""
    label: str
    function: Callable[[Array, Array], Array]
    """Function of y and y_hat, each (samples, ny) in physical units, that returns one value per
    output, (ny,)."""
    loss: TrainingLoss = "mse"
    """The loss of `asia.models.methods` that fits a model to be judged by this metric."""
    unit: str = "signal"
    """`signal`: the unit of the output, and V divides by the output's standard deviation; any
    other text is the unit itself, `""` for none, and V divides by nothing."""
    direction: Literal["lower", "higher"] = "lower"
    best: float = 0.0
    """The value of a simulation that equals the measurement."""

    @property
    def normalised(self) -> bool:
        """Whether V divides by the standard deviation of the output."""
        return self.unit == "signal"

    @property
    def v_label(self) -> str:
        """Label of the quantity that V averages over outputs and folds, such as `RMSE / output
        std`."""
        if self.direction == "higher":
            return f"{self.best:g} - {self.label}"
        return f"{self.label} / output std" if self.normalised else self.label

    @property
    def summary(self) -> str:
        """V in a word or two, such as `normalised simulation RMSE`."""
        if self.direction == "higher":
            return f"simulation {self.v_label}"
        return f"{'normalised ' if self.normalised else ''}simulation {self.label}"

    @property
    def v_words(self) -> str:
        """Description of the quantity that V averages, for use in a sentence."""
        if self.direction == "higher":
            return f"{self.best:g} less the {self.label} of each output, lower is better"
        spread = " over its standard deviation in the training fold" if self.normalised else ""
        return f"{self.label} of each output{spread}"

    @property
    def v_unit(self) -> str:
        """The unit of V, `-` for none."""
        return "-" if self.normalised else self.unit or "-"

    def unit_of(self, signal: str) -> str:
        """The unit of a value for an output in the unit `signal`."""
        return signal if self.normalised else self.unit

    def shortfall(self, y: Array, y_hat: Array, scale: Array) -> float:
        """Return the contribution to V: the mean of `shortfalls` over the outputs that have one.

        Raises:
            UserError: as `shortfalls`
        """
        return mean_of_known(self.shortfalls(y, y_hat, scale))

    def shortfalls(self, y: Array, y_hat: Array, scale: Array) -> Array:
        """Return the quantity that V averages over the outputs, (ny,): 0 at best, lower is better.

        Samples where `y` is NaN do not count; an output without any other has NaN.

        Args:
            y, y_hat: (samples, ny) in physical units
            scale: (ny,) standard deviations

        Raises:
            UserError: when the function does not return one number per output
        """
        values = self.values(y, y_hat)
        if self.direction == "higher":
            values = self.best - values
        return values / scale if self.normalised else values

    def values(self, y: Array, y_hat: Array) -> Array:
        """The values of the outputs, (ny,).

        Raises:
            UserError: as `shortfalls`
        """
        values = np.asarray(by_measured(self.function, y, y_hat), dtype=np.float64)
        if values.shape != y.shape[1:]:
            raise UserError(
                f"metric '{self.name}' gives an array of shape {values.shape}, expected "
                f"{y.shape[1:]}, one number an output: mend its function"
            )
        return values


def by_measured(function: Callable[[Array, Array], Array], y: Array, y_hat: Array) -> Array:
    """`function` of y and y_hat, each (samples, ny), over the samples at which an output was
    measured, which differ by output: (ny,); NaN for an output without any."""
    known = ~np.isnan(y)
    if known.all():
        return function(y, y_hat)
    each = [
        function(y[k, c : c + 1], y_hat[k, c : c + 1])[0] if k.any() else np.nan
        for c, k in enumerate(known.T)
    ]
    return np.array(each, dtype=np.float64)


def mean_of_known(values: Array) -> float:
    """Return the mean of the numbers that are not NaN; NaN where there is none."""
    known = values[~np.isnan(values)]
    return float(np.mean(values if len(known) == len(values) or not len(known) else known))


def rmse(y: Array, y_hat: Array) -> Array:
    """Root mean square error of each channel, (ny,)."""
    return np.sqrt(np.mean((y - y_hat) ** 2, axis=0))


def mae(y: Array, y_hat: Array) -> Array:
    """Mean absolute error of each channel, (ny,)."""
    return np.mean(np.abs(y - y_hat), axis=0)


METRICS = {m.name: m for m in (Metric("rmse", "RMSE", rmse), Metric("mae", "MAE", mae, "mae"))}
"""The built-in metrics by name."""


def metric_names() -> tuple[str, ...]:
    """The built-in metrics, then those of installed packages."""
    return (*METRICS, *(part.name for part in parts_of(_GROUP) if part.name not in METRICS))


def listed_metrics(but: str = "") -> str:
    """Return the built-in metrics as they stand in a problem file: `"rmse" or "mae"`."""
    return " or ".join(f'"{name}"' for name in METRICS if name != but)


def find_metric(name: str) -> Metric:
    """The metric of that name.

    Raises:
        UserError: when there is none, or an installed package brings something else by that
            name
    """
    if name in METRICS:
        return METRICS[name]
    for part in parts_of(_GROUP):
        if part.name == name:
            found = part.load()
            if not isinstance(found, Metric) or found.name != name:
                raise UserError(
                    f"{part.target} of package {part.package} {part.version} is {found!r}, "
                    f"expected an asia.problem.metrics.Metric whose name is '{name}'"
                )
            return found
    raise UserError(
        f"there is no metric '{name}'{suggestion(name, metric_names())} (installed are "
        f"{', '.join(metric_names())}): install the package that brings it"
    )


def metric_label(name: str) -> str:
    """Return the label of a metric named in a problem or a ledger.

    Test metrics are included, and metrics of packages that are no longer installed.
    """
    try:
        return find_metric(name).label
    except UserError:
        return name.upper() if name == MEE else name


def known_metric(name: str) -> str:
    """`name` where it is a metric's.

    Raises:
        ValueError: that lists the metrics, for schemas
    """
    return _one_of(name, metric_names())


def known_test_metric(name: str) -> str:
    """Return the metric of this name for the sealed test, as `known_metric`."""
    return _one_of(name, (*metric_names(), MEE))


def _one_of(name: str, names: Sequence[str]) -> str:
    if name not in names:
        *first, last = (f"'{known}'" for known in names)
        listed = f"{', '.join(first)} or {last}"
        raise ValueError(f"is '{name}', expected {listed}{suggestion(name, names)}")
    return name
