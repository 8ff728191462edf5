"""A person's equations: simulation and fit."""
