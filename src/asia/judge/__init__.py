"""Judge: from the source of a candidate to its score."""
