"""Conformance suite of export targets."""

import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Signal
from asia.errors import UserError
from asia.export.model import ExportModel, Printed
from asia.export.target import Target, parity_row
from asia.lowering.evaluation import simulate
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered_bytes
from asia.lowering.wire import unpack

_NU, _NY, _PAST = 2, 2, 3


def check_export_target(target: Target) -> None:
    """Print made-up models with the target, run the files and compare the simulations.

    Checked: the target has a name and a usage text; a model is printed twice to the same bytes; the
    file names stay inside the folder; the files give one simulation for each window, within the
    parity limit of `asia export`; they hold the model that was printed last, not one of before. A
    target may refuse a model with UserError, but not the linear one. Files that cannot be run on
    this machine are not compared. Raises AssertionError that says what fails; a target that is not
    installed is an AssertionError too.
    """
    assert target.name.isidentifier(), f"the name {target.name!r} is no identifier"
    assert target.usage.strip(), "usage is empty"
    missing = target.missing()
    assert missing is None, f"the target cannot be checked here: {missing}"
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made, target.name)
        for name, model in _models().items():
            try:
                printed = target.print(model)
            except UserError:
                assert not name.startswith("linear"), f"the {name} model is refused"
                continue
            again = target.print(model)
            assert printed.files, f"the {name} model: no file was printed"
            for file, data in printed.files.items():
                place = PurePosixPath(file)
                inside = not place.is_absolute() and ".." not in place.parts
                assert inside, f"the {name} model: file {file!r} lies outside the folder"
                written = file in ("USE.md", "model.json")
                assert not written, f"{file} is written by `asia export`"
                same = data == again.files.get(file)
                assert same, f"the {name} model: {file} differs when printed again"
            same = printed.files.keys() == again.files.keys()
            assert same, f"the {name} model: other files when again"
            _check_simulations(target, folder, printed, model, name)


def _check_simulations(
    target: Target, folder: Path, printed: Printed, model: ExportModel, name: str
) -> None:
    for file, data in printed.files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    windows = _windows(model.lowered)
    answers = target.run(folder, windows)
    if isinstance(answers, str):
        assert answers.strip(), "run gives an empty reason"
        return
    assert answers, f"the {name} model: run gives no simulation"
    for answer in answers:
        where = f"the {name} model, {answer.variant}"
        count = len(answer.y_hat)
        assert count == len(windows), f"{where}: {count} simulations of {len(windows)} windows"
        row = parity_row(target.name, answer, windows, model.lowered.single, printed.bytes)
        assert row.holds, (
            f"{where}: the files differ by {row.difference:.1e} of the outputs' spread, at most "
            f"{row.limit:.0e} is allowed"
        )


class _Linear:
    """State-space model whose initial state is a linear function of the past window."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        self.a = np.array([[0.8, 0.2, 0.0], [-0.1, 0.7, 0.1], [0.0, 0.0, 0.5]])
        self.b, self.c = 0.4 * random.normal(size=(_NU, 3)), random.normal(size=(3, _NY))
        self.start = 0.2 * random.normal(size=(_PAST * (_NU + _NY), 3))

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        del u
        rows = len(past_u)
        flat = past_u.reshape(rows, -1), past_y.reshape(rows, -1)
        half = _PAST * _NU
        return flat[0] @ self.start[:half] + flat[1] @ self.start[half:]

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        return state @ self.a + u @ self.b, state @ self.c


class _Nonlinear(_Linear):
    """Elementary functions, a saturation, a branch and a second state."""

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State (B, 3), and inputs of the sample before (B, nu)."""
        return super().initial(past_u, past_y, u), past_u[:, -1]

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        import jax.numpy as jnp

        x, before = state
        moved = jnp.tanh(x @ self.a + before @ self.b)
        moved = jnp.where(moved > 0.5, 0.25 + 0.5 * moved, moved)
        y = moved @ self.c + jnp.clip(u[:, :1], -0.5, 0.5) + jnp.sqrt(1.0 + x[:, :1] ** 2)
        return (moved, u), y * jnp.exp(-0.1 * jnp.abs(y))


def _models() -> dict[str, ExportModel]:
    import jax

    spans = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    inputs = Signal("valve", "V"), Signal("heater 2", "W")
    outputs = Signal("level", "mm"), Signal("temperature", "°C")
    made = {"linear": _Linear(1), "other linear": _Linear(2), "nonlinear": _Nonlinear(3)}
    models: dict[str, ExportModel] = {}
    double = jax.dtypes.canonicalize_dtype(float) == np.float64
    try:
        for name, model in made.items():
            lowered = unpack(lowered_bytes(model, _PAST, _PAST, _NU, _NY))
            assert isinstance(lowered, LoweredModel), lowered
            example = _windows(lowered)[0].part(0, 10)
            models[name] = ExportModel(
                "made_up", "refit", "made_up", lowered, inputs, outputs, 0.5, spans, spans, example
            )
    finally:
        jax.config.update("jax_enable_x64", double)
    return models


def _windows(lowered: LoweredModel) -> Sequence[SimulatedSegment]:
    random = np.random.default_rng(0)

    def drawn(samples: int, channels: int) -> Array:
        return random.uniform(-1.0, 1.0, (samples, channels))

    windows: list[SimulatedSegment] = []
    for samples in (40, 20):
        past_u, past_y, u = drawn(_PAST, _NU), drawn(_PAST, _NY), drawn(samples, _NU)
        y_hat = simulate(lowered, past_u, past_y, u)
        windows.append(SimulatedSegment(past_u, past_y, u, y_hat, y_hat=y_hat))
    return windows
