"""Linear state-space systems: response, starts, fits."""
