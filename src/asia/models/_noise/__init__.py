"""Noise model of the residual of a simulation, and its use in a fit."""
