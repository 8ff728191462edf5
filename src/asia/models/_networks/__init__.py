"""Networks: structures, simulation, training methods."""
