"""What the residual of a simulation consists of, and how a fit takes it into account."""
