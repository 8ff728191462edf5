"""Linear state-space systems: start, fit, choice."""
