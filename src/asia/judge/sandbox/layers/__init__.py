"""Sandbox layers, the building blocks of the levels."""
