"""Coding agents that run as commands: in a jail, capped, resumed."""
