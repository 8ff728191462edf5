"""Drivers from outside: a desk where candidates are handed in, and who hands them in."""
