"""Training records in the form that the models read."""
