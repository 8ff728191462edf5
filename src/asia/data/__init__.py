"""Measurements: signals, records, their digests and sources.

Light: a sandboxed worker imports it.
"""

from asia.data.trajectory import Array, Mask, Signal, Trajectory, data_digest, filled, spread_of

__all__ = ["Array", "Mask", "Signal", "Trajectory", "data_digest", "filled", "spread_of"]
