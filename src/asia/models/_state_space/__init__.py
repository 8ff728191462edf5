"""Neural state-space and block-oriented structures."""
