"""Catalogue of plants: equations, roles and words as data, one file each."""
