"""Traces of an attack and the verdict on them."""
