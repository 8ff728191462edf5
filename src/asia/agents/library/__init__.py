"""The model library as the built-in agents know it."""
