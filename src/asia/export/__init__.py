"""Print a fitted model for other programs: one lowering, one printer for each target."""
