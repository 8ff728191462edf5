"""Measurements as a laboratory keeps them, made into records: files of many formats are read as
sheets of columns, put on one time grid, cut at gaps, and written down as what was done to them."""
