"""Equations from the problem file: simulation and fit."""
