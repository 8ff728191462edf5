"""Additions to the equations, and priors on their parameters."""
