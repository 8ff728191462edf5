"""Common parts of the network families: simulation, training methods, layers."""
