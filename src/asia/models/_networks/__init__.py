"""What the network families share: simulation, training methods, layers."""
