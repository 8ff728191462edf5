"""A person's equations: what they may hold, and their checks."""
