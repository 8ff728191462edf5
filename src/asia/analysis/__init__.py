"""Analysis of a finished model: validation, confirmation, ablation."""
