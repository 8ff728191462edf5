"""Made-up benchmark files in the layout of the published ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.signal import lfilter

Values = np.ndarray


def response(u: Values, seed: int = 0, scale: float = 1.0) -> Values:
    """A lightly damped linear system with a soft saturation and noise; along axis 0."""
    linear = lfilter([0.0, 0.2, 0.1], [1.0, -1.2, 0.5], u, axis=0)
    noise = np.random.default_rng([seed, 7]).standard_normal(u.shape)
    return scale * (np.tanh(linear) + 0.005 * noise)


def noise_input(seed: int, *shape: int) -> Values:
    return lfilter([1.0], [1.0, -0.5], np.random.default_rng(seed).standard_normal(shape), axis=0)


def periodic(seed: int, samples: int, *shape: int, periods: int = 2) -> tuple[Values, Values]:
    """Input and output (samples, *shape, periods) in steady state, other noise in each period."""
    u = noise_input(seed, samples, *shape)
    warm = response(np.concatenate([u] * (periods + 1)), seed)[samples:]
    y = warm.reshape(periods, samples, *shape)
    return np.stack([u] * periods, axis=-1), np.moveaxis(y, 0, -1)


def write_cascaded_tanks(root: Path, samples: int = 1_024) -> None:
    folder = _folder(root, "Cascaded_Tanks/CascadedTanksFiles")
    arrays: dict[str, Values] = {"Ts": np.array([[4.0]])}
    for k, name in enumerate(("Est", "Val")):
        u = noise_input(k, samples, 1)
        arrays |= {f"u{name}": u, f"y{name}": response(u, k)}
    savemat(folder / "dataBenchmark.mat", arrays)


def write_ced(root: Path) -> None:
    folder = _folder(root, "CED")
    arrays: dict[str, Values] = {}
    for k, amplitude in (("1", 0.5), ("2", 1.5)):
        u = amplitude * np.sign(noise_input(int(k), 500, 1))
        arrays |= {f"u1{k}": u, f"z1{k}": np.abs(response(u, int(k)))}
    savemat(folder / "DATAUNIF.MAT", arrays)


def write_emps(root: Path, samples: int = 2_400) -> None:
    folder = _folder(root, "EMPS")
    for k, name in enumerate(("DATA_EMPS", "DATA_EMPS_PULSES")):
        t = np.arange(samples)[:, None] * 0.0010000240583
        u = noise_input(k, samples, 1)
        arrays = {"t": t, "vir": u, "qm": response(u, k, 0.1), "qg": response(u, k, 0.1)}
        savemat(folder / f"{name}.mat", arrays)


def write_silverbox(root: Path, samples: int = 131_072) -> None:
    u = 0.05 * noise_input(0, samples)
    y = response(u, scale=0.1)
    folder = _folder(root, "Silverbox/SilverboxFiles")
    savemat(folder / "SNLS80mV.mat", {"V1": u[None], "V2": y[None]})


def write_wiener_hammerstein(root: Path, samples: int = 188_000) -> None:
    u = noise_input(0, samples, 1)
    arrays = {"uBenchMark": u, "yBenchMark": response(u), "fs": 51_200.0}
    savemat(_folder(root, "WienerHammerBenchMark") / "WienerHammerBenchMark.mat", arrays)


def write_fine_steering_mirror(root: Path, samples: int = 256) -> None:
    folder = _folder(root, "FineSteeringMirror")
    for subset, realisations in (("train", 6), ("test", 3)):
        for level in (100, 200, 300):
            u, y = periodic(level + realisations, samples, 3, realisations)
            np.save(folder / f"u_{level}mV_{subset}.npy", level * 1e-3 * u)
            np.save(folder / f"y_{level}mV_{subset}.npy", level * 1e-8 * y)


def write_parallel_wiener_hammerstein(root: Path, samples: int = 64, phases: int = 20) -> None:
    arrays: dict[str, Values] = {"fs": np.array([[78_125.0]]), "amp": np.arange(1.0, 6.0)[None]}
    for name, count in (("Est", phases), ("Val", 1)):
        u, y = periodic(count, samples, count, 5)
        arrays |= {f"u{name}": np.moveaxis(u, -1, 1), f"y{name}": np.moveaxis(y, -1, 1)}
    savemat(_folder(root, "ParWH/ParWHFiles") / "ParWHData.mat", arrays)


def write_f16(root: Path, samples: int = 600, sweep: int = 800) -> None:
    folder = _folder(root, "F16/F16GVT_Files/BenchmarkData")
    for level in range(1, 8):
        for kind, length in (("FullMSine", samples), ("SineSw", sweep)):
            u = 10.0 * level * noise_input(level, length)
            y = np.stack([response(0.02 * u, k) for k in range(3)])
            ending = "_Validation" if level % 2 == 0 else ""
            savemat(
                folder / f"F16Data_{kind}_Level{level}{ending}.mat",
                {"Force": u[None], "Voltage": u[None] / 50.0, "Acceleration": y, "Fs": 400.0},
            )
    u = noise_input(9, samples)
    arrays = {"Force": np.stack([u] * 3), "Acceleration": np.zeros((3, 3, samples)), "Fs": 400.0}
    savemat(folder / "F16Data_SpecialOddMSine_Level1.mat", arrays)


def _folder(root: Path, name: str) -> Path:
    folder = root / "nonlinear_benchmarks" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


WRITERS = {
    "cascaded_tanks": write_cascaded_tanks,
    "ced": write_ced,
    "emps": write_emps,
    "silverbox": write_silverbox,
    "wiener_hammerstein": write_wiener_hammerstein,
    "fine_steering_mirror": write_fine_steering_mirror,
    "parallel_wiener_hammerstein": write_parallel_wiener_hammerstein,
    "f16": write_f16,
}
"""Writer of the files of a benchmark below a folder that ASIA_DATA_DIR can name."""
