"""Interfaces: command line, Python, workspace, MCP, coding agents."""
