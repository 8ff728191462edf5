"""Systems whose records ASIA simulates itself, from a seed."""
