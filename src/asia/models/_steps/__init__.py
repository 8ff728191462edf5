"""Library models one sample at a time, for `as_steps`: written for JAX, which traces them."""
