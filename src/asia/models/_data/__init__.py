"""Training records as the models see them."""
