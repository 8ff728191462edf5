"""(y, y_hat) -> Score or Failure. Sees targets, never runs a candidate."""
