"""Systems whose records ASIA simulates itself, from a seed."""

from asia.data.sources.simulated.source import SYSTEMS, Simulated

__all__ = ["SYSTEMS", "Simulated"]
