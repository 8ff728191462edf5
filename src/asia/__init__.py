"""ASIA: the Autonomous System Identification Agent."""

__version__ = "0.1.0"
