"""Printers of the export targets."""
