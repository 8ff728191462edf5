"""Access to data hidden from the search: test records and guard records."""
