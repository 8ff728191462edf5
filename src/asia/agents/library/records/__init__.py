"""What the training records say before any model is fitted."""
