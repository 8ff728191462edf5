"""Analysis of the training records before any model is fitted."""
