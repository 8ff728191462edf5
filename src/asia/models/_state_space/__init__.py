"""Neural state-space and block-oriented models."""
