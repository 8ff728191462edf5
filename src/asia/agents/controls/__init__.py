"""Agents that the others are compared with."""
