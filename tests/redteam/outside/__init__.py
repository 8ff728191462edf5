"""Attacks with isolation off, in an outer sandbox."""
