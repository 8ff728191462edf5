"""Equations of a problem file: allowed content and checks."""
