"""Intake of laboratory measurements: read files of many formats, put them on one time grid, cut
them at gaps, and record the changes."""
