"""Evaluation of candidates: folds, sandbox and scoring together.

This package holds targets and runs candidates, never both at once: a worker receives the inputs of
a `Segment` and its past windows, and the scored outputs stay here."""
