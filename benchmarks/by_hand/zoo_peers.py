"""Other tools on the systems of `zoo.py`: error on the test record, in its standard deviations.

Each tool is used as its documentation does it, and chooses its sizes by the last quarter of the
training record. Then it is fitted to the whole record and simulates the test record from its first
ten samples. The neural models of jax-sysid are fitted from seed after seed until the seconds are
spent, and the best on the last quarter is refitted. sysidentpy has one output a model: one is
fitted for each output. Needs an environment with jax-sysid and sysidentpy.

    python benchmarks/by_hand/zoo_peers.py --zoo DATA/zoo --seconds 60
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import sys
import time
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PAST = 10
Record = tuple[np.ndarray, np.ndarray]
Simulate = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""u (N, nu), the first y (PAST, ny) -> y (N, ny)."""

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore")


def load(folder: Path) -> tuple[Record, Record]:
    """Training and test record."""
    declared = tomllib.loads((folder / "problem.toml").read_text("utf-8"))
    names = [[signal["name"] for signal in declared[kind]] for kind in ("inputs", "outputs")]

    def record(file: str) -> Record:
        with (folder / file).open(encoding="utf-8", newline="") as opened:
            rows = list(csv.DictReader(opened))
        u, y = (np.array([[float(row[name]) for name in kind] for row in rows]) for kind in names)
        return u, y

    return record(declared["data"]["train"][0]), record(declared["data"]["test"][0])


def error(y: np.ndarray, y_hat: np.ndarray, scale: np.ndarray) -> float:
    """Root mean square over the samples after the first ten and the outputs, in units of scale."""
    found = float(np.sqrt(np.mean(((y - y_hat)[PAST:] / scale) ** 2)))
    return found if np.isfinite(found) else np.inf


def arx(train: Record, order: int) -> Simulate:
    """Least squares on `order` past inputs and outputs, and the present input."""
    u, y = train

    def regressors(u: np.ndarray, y: np.ndarray, k: int) -> np.ndarray:
        return np.concatenate([y[k - order : k].ravel(), u[k - order : k + 1].ravel(), [1.0]])

    rows = np.array([regressors(u, y, k) for k in range(order, len(u))])
    weights = np.linalg.lstsq(rows, y[order:], rcond=None)[0]

    def simulate(u: np.ndarray, first: np.ndarray) -> np.ndarray:
        y = np.concatenate([first, np.zeros((len(u) - PAST, first.shape[1]))])
        for k in range(PAST, len(u)):
            y[k] = np.clip(regressors(u, y, k) @ weights, -1e6, 1e6)
        return y

    return simulate


def jax_sysid(train: Record, states: int, units: int, seed: int) -> Simulate:
    """A state-space model of jax-sysid; units: tanh units of the neural one, 0 for a linear one."""
    from jax_sysid.models import LinearModel, Model

    u, y = train
    nu, ny = u.shape[1], y.shape[1]
    if units:
        random = np.random.default_rng(seed)

        def drawn(*shape: int) -> np.ndarray:
            return 0.1 * random.standard_normal(shape)

        @jax.jit
        def state(x: Any, u: Any, params: Any) -> Any:
            p = params
            return p[0] @ x + p[1] @ u + p[4] @ jnp.tanh(p[2] @ x + p[3] @ u + p[5])

        @jax.jit
        def output(x: Any, u: Any, params: Any) -> Any:
            p = params
            return p[6] @ x + p[7] + p[8] @ jnp.tanh(p[9] @ x + p[10])

        model = Model(states, ny, nu, state_fcn=state, output_fcn=output)
        model.init(
            params=[
                0.9 * np.eye(states), drawn(states, nu), drawn(units, states), drawn(units, nu),
                drawn(states, units), drawn(units), drawn(ny, states), drawn(ny), drawn(ny, units),
                drawn(units, states), drawn(units),
            ]
        )  # fmt: skip
    else:
        model = LinearModel(states, ny, nu, feedthrough=True)
    model.loss(rho_x0=1e-4, rho_th=1e-4)
    model.optimization(adam_epochs=1000, lbfgs_epochs=1000, adam_eta=1e-3, iprint=-1)
    model.fit(y, u)

    def simulate(u: np.ndarray, first: np.ndarray) -> np.ndarray:
        x0 = model.learn_x0(u[:PAST], first, rho_x0=1e-4, verbosity=False)
        return np.asarray(model.predict(x0, u)[0])

    return simulate


def sysidentpy(train: Record, degree: int, lags: int) -> Simulate:
    """Polynomial NARX by forward regression, a model for each output."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS

    u, y = train
    models: list[Any] = []
    for i in range(y.shape[1]):
        several = [list(range(1, lags + 1))] * u.shape[1]
        model = FROLS(
            order_selection=True, n_info_values=15, info_criteria="bic", ylag=lags,
            xlag=several if u.shape[1] > 1 else lags, basis_function=Polynomial(degree=degree),
        )  # fmt: skip
        model.fit(X=u, y=y[:, i : i + 1])
        models.append(model)

    def simulate(u: np.ndarray, first: np.ndarray) -> np.ndarray:
        found: list[np.ndarray] = []
        for i, model in enumerate(models):
            lag = model.max_lag
            y_hat = model.predict(X=u[PAST - lag :], y=first[PAST - lag :, i : i + 1])
            found.append(np.concatenate([first[: PAST - lag, i], np.ravel(y_hat)]))
        return np.stack(found, axis=1)

    return simulate


def best(
    train: Record, test: Record, fits: list[Callable[[Record], Simulate]], seconds: float
) -> tuple[float, float]:
    """Test error of the fit that is best on the last quarter, and seconds."""
    begin = time.monotonic()
    (u, y), cut = train, 3 * len(train[0]) // 4
    scale = y.std(axis=0)
    part, rest = (u[:cut], y[:cut]), (u[cut:], y[cut:])
    found: list[tuple[float, int]] = []
    for i, fit in enumerate(fits):
        if found and time.monotonic() - begin > seconds / 2:
            break
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                y_hat = fit(part)(rest[0], rest[1][:PAST])
            found.append((error(rest[1], y_hat, scale), i))
        except (ArithmeticError, ValueError, TypeError, np.linalg.LinAlgError) as failure:
            print(f"  {type(failure).__name__}: {failure}"[:100], file=sys.stderr)
    if not found:
        return np.inf, time.monotonic() - begin
    u, y = test
    with contextlib.redirect_stdout(io.StringIO()):
        y_hat = fits[min(found)[1]](train)(u, y[:PAST])
    value = error(y, y_hat, y.std(axis=0))
    return value, time.monotonic() - begin


def main() -> None:
    """Print a row for each system."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--zoo", type=Path, required=True)
    parser.add_argument("--systems", nargs="+")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each tool and system")
    given = parser.parse_args()
    tools: dict[str, list[Callable[[Record], Simulate]]] = {
        "ARX": [lambda r, n=n: arx(r, n) for n in range(1, 11)],
        "jax-sysid linear": [lambda r, n=n: jax_sysid(r, n, 0, 0) for n in range(1, 9)],
        "jax-sysid neural": [
            lambda r, n=n, seed=seed: jax_sysid(r, n, 8, seed)
            for seed in range(20)
            for n in (2, 4, 6)
        ],
        "sysidentpy": [
            lambda r, d=d, n=n: sysidentpy(r, d, n) for d, n in ((1, 5), (2, 2), (2, 5), (3, 2))
        ],
    }
    print(f"| system | mean | {' | '.join(f'{tool} | s' for tool in tools)} |")
    print("|---|---|" + "---|---|" * len(tools))
    for name in given.systems or sorted(path.name for path in given.zoo.iterdir()):
        train, test = load(given.zoo / name)
        centre = [part.mean(axis=0) for part in train]
        spread = [part.std(axis=0) + 1e-12 for part in train]
        train, test = (
            tuple((part - c) / s for part, c, s in zip(record, centre, spread, strict=True))
            for record in (train, test)
        )
        cells = [f"{error(test[1], np.zeros_like(test[1]), test[1].std(axis=0)):.3f}"]
        for fits in tools.values():
            value, took = best(train, test, fits, given.seconds)
            cells += [f"{value:.3f}", f"{took:.0f}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
