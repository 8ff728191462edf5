"""Systems whose records ASIA simulates itself, from a seed."""

from dataclasses import dataclass

from asia.data.trajectory import Array


@dataclass(frozen=True)
class Simulation:
    """A simulated record, (T, 1) each."""

    u: Array
    y: Array
    truth: Array
